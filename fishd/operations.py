"""What can be asked of a running daemon: each operation of the control protocol, over one loop."""

import asyncio
import os
from collections.abc import Awaitable, Callable
from typing import Any, ParamSpec, TypeVar

import msgspec
from msgspec import Struct

from fishd import __version__, protocol
from fishd.clock import Clock
from fishd.config import Config
from fishd.controllers import registry
from fishd.errors import ParameterError, Refused, UnknownController
from fishd.loop import ControlLoop
from fishd.policies import library
from fishd.policies.info import PolicyInfo
from fishd.protocol import State
from fishd.schema import Problem, convert, fields_of, nearest
from fishd.signals import ControllerInfo, Status
from fishd.supervisor import Mode
from fishd.workbench import Workbench

P = ParamSpec("P")
T = TypeVar("T")

MOST_LOADING = 4
"""Requests that may be reading files at once, each in a thread of its own."""


class Operations:
    """Answers requests from what the loop knows, and makes changes between its ticks."""

    def __init__(
        self,
        loop: ControlLoop,
        clock: Clock,
        workbench: Workbench,
        config: Config,
        controllers: list[ControllerInfo],
        telemetry: str,
        realtime: bool,
    ) -> None:
        """
        config: what fishd was started with
        controllers: all that can be put in command
        telemetry: the address that clients are told
        realtime: is SCHED_FIFO in force?
        """
        self._loop = loop
        self._clock = clock
        self._telemetry = telemetry
        self._realtime = realtime
        self._workbench = workbench
        self._config = config
        self._started = clock.monotonic()
        self._decisions = 0
        self._loading = 0
        self._controllers = controllers
        self._operations: dict[str, tuple[type[Struct], Callable[[Any], Awaitable[Any]]]] = {
            "status": (protocol.NoArguments, self._status),
            "controllers": (protocol.NoArguments, self._list_controllers),
            "policies": (protocol.NoArguments, self._list_policies),
            "config": (protocol.NoArguments, self._tell_config),
            "set-controller": (protocol.SetController, self._set_controller),
            "set-parameter": (protocol.SetParameter, self._set_parameter),
            "stop": (protocol.NoArguments, self._stop),
            "estop": (protocol.Estop, self._estop),
            "clear-fault": (protocol.NoArguments, self._clear_fault),
            "mark": (protocol.Mark, self._mark),
            **workbench.operations,
        }

    async def perform(self, op: str, args: dict[str, Any]) -> Any:
        """Do what a request asks for and return its result; raises `Refused`."""
        if op not in self._operations:
            raise Refused("unknown-op", f"no such op '{op}'; {nearest(op, list(self._operations))}")
        expected, operation = self._operations[op]
        try:
            arguments: Any = convert(args, expected)
        except Problem as problem:
            path = ".".join(problem.path)
            raise Refused("bad-arguments", f"{op}: {path}: {problem}") from None
        return await operation(arguments)

    def status(self) -> Status:
        """The daemon in one snapshot."""
        loop = self._loop
        observation = loop.observation
        return Status(
            t=self._clock.wall(),
            version=__version__,
            pid=os.getpid(),
            uptime=self._clock.monotonic() - self._started,
            mode=loop.supervisor.mode.value,
            reason=loop.supervisor.reason,
            controller=loop.controller_name,
            parameters=msgspec.structs.asdict(loop.controller.parameters),
            servo_on=loop.servo_on,
            thrust=observation.thrust if observation else 0.0,
            frequency=observation.frequency if observation else 0.0,
            tick=loop.limits.tick,
            amplitude_limit=loop.limits.amplitude,
            lowest=loop.guard.lowest,
            highest=loop.guard.highest,
            seq=loop.seq,
            missed=loop.statistics.missed,
            overruns=loop.statistics.overruns,
            timing=loop.statistics.timing(),
            robot=loop.robot.name,
            degraded=loop.robot.degraded(),
            counters=loop.robot.counters(),
            realtime=self._realtime,
            telemetry=self._telemetry,
            servo_lost=loop.servo_lost,
            fallback=loop.fallback,
            sensor_lost=loop.supervisor.sensor_lost,
            calibrating=self._workbench.calibrating,
        )

    async def _status(self, _: protocol.NoArguments) -> Status:
        return self.status()

    async def _list_controllers(self, _: protocol.NoArguments) -> list[ControllerInfo]:
        return self._controllers

    async def _list_policies(self, _: protocol.NoArguments) -> list[PolicyInfo]:
        self._check_busy()
        limits = self._loop.limits
        return await self._aside(library.describe_all, limits.tick, limits.amplitude)

    async def _tell_config(self, _: protocol.NoArguments) -> Config:
        return self._config

    async def _set_controller(self, wanted: protocol.SetController) -> State:
        self._loop.supervisor.check_startable()  # before it is loaded in vain
        self._workbench.check_startable(wanted.name)
        self._check_busy()
        decision = self._decide()
        try:
            controller = await self._aside(
                registry.create, wanted.name, wanted.parameters, self._loop.limits
            )
        except UnknownController as error:
            raise Refused("unknown-controller", str(error)) from None
        except ParameterError as error:
            raise Refused("bad-parameter", str(error)) from None
        except Exception as error:
            what = f"controller '{wanted.name}' cannot start: {type(error).__name__}: {error}"
            raise Refused("controller-error", what) from error
        if decision != self._decisions:
            controller.close()
            raise Refused(
                "superseded", f"while '{wanted.name}' was loading, a newer request was carried out"
            )
        try:
            self._workbench.check_startable(wanted.name)
            self._loop.set_controller(wanted.name, controller)
        except Refused:  # a fault since, or a calibration
            controller.close()
            raise
        return self._state()

    async def _set_parameter(self, wanted: protocol.SetParameter) -> State:
        loop = self._loop
        loop.supervisor.check_startable()
        if loop.supervisor.mode is not Mode.RUNNING:
            raise Refused(
                "not-running",
                f"no controller is running (mode {loop.supervisor.mode}); "
                "start one with 'fishctl set-controller'",
            )
        for field in fields_of(type(loop.controller.parameters)):
            if field.file and field.name in wanted.parameters:  # no tick waits for a file
                raise Refused("bad-parameter", _why_not_in_flight(loop.controller_name, field.name))
        try:
            loop.retune(registry.merged(loop.controller, loop.controller_name, wanted.parameters))
        except ParameterError as error:
            raise Refused("bad-parameter", str(error)) from None
        except Exception as error:
            what = f"controller '{loop.controller_name}' refused: {type(error).__name__}: {error}"
            raise Refused("controller-error", what) from error
        return self._state()

    async def _stop(self, _: protocol.NoArguments) -> State:
        self._decide()
        self._loop.stop()
        return self._state()

    async def _estop(self, wanted: protocol.Estop) -> State:
        self._decide()
        self._loop.estop(wanted.message)
        return self._state()

    async def _clear_fault(self, _: protocol.NoArguments) -> State:
        self._decide()
        self._loop.clear_fault()
        return self._state()

    async def _mark(self, wanted: protocol.Mark) -> State:
        self._loop.reporter.event("mark", wanted.text)
        return self._state()

    def _check_busy(self) -> None:
        if self._loading >= MOST_LOADING:
            raise Refused("busy", f"{self._loading} requests are reading files; try again")

    async def _aside(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call in a thread what may load files and warm up: the tick must not wait for it."""
        self._loading += 1
        try:
            return await asyncio.to_thread(function, *args, **kwargs)
        finally:
            self._loading -= 1

    def _decide(self) -> int:
        """Count a decision on who is in command; one that loads slowly must not undo a newer."""
        self._decisions += 1
        return self._decisions

    def _state(self) -> State:
        loop = self._loop
        return State(
            seq=loop.seq + 1,
            mode=loop.supervisor.mode.value,
            reason=loop.supervisor.reason,
            controller=loop.controller_name,
            parameters=msgspec.structs.asdict(loop.controller.parameters),
        )


def _why_not_in_flight(controller: str, parameter: str) -> str:
    return (
        f"{controller}: {parameter}: it cannot change in flight; start the controller again: "
        f"'fishctl set-controller {controller} --{parameter.replace('_', '-')} …'"
    )
