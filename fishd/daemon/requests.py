"""What can be asked of a running daemon: each operation of the control protocol, over one loop."""

import logging
import os
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from msgspec import Struct

from fishd import __version__, protocol, text
from fishd.asides import Asides
from fishd.clock import Clock
from fishd.config import Config
from fishd.contained import contained
from fishd.controllers import registry
from fishd.controllers.base import Controller
from fishd.errors import ParameterError, Refused, UnknownController
from fishd.loop import ControlLoop
from fishd.policies import library
from fishd.policies.info import PolicyInfo
from fishd.protocol import State
from fishd.schema import Problem, convert, fields_of, nearest
from fishd.signals import ControllerInfo, Status
from fishd.supervisor import Mode
from fishd.workbench import Workbench

log = logging.getLogger(__name__)


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
        counters: Callable[[], dict[str, int]] = dict,
        loading: float = protocol.LOADING,
    ) -> None:
        """
        config: what fishd was started with
        controllers: all that can be put in command
        telemetry: the address that clients are told
        realtime: is SCHED_FIFO in force?
        counters: what was survived outside of the robot, since start
        loading: how long a controller may take to load [s]
        """
        self._loop = loop
        self._clock = clock
        self._telemetry = telemetry
        self._realtime = realtime
        self._counters = counters
        self._workbench = workbench
        self._config = config
        self._started = clock.monotonic()
        self._decisions = 0
        self._asides = Asides(loading)
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
            hint = nearest(op, list(self._operations))
            raise Refused("unknown-op", f"no such op '{text.quoted(op)}'; {hint}")
        expected, operation = self._operations[op]
        try:
            arguments: Any = convert(args, expected)
        except Problem as problem:
            path = text.quoted(".".join(problem.path))
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
            parameters=loop.parameters,
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
            counters={**loop.robot.counters(), **self._counters()},
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
        self._asides.check_busy()
        limits = self._loop.limits
        describe = partial(library.describe_all, limits.tick, limits.amplitude)
        return await self._asides.call("the policy files have not been read", describe)

    async def _tell_config(self, _: protocol.NoArguments) -> Config:
        return self._config

    async def _set_controller(self, wanted: protocol.SetController) -> State:
        self._loop.supervisor.check_startable()  # before it is loaded in vain
        self._workbench.check_startable(wanted.name)
        self._asides.check_busy()
        decision = self._decide()
        controller = await self._load(wanted)
        if decision != self._decisions:
            self._dispose(controller)
            raise Refused(
                "superseded", f"while '{wanted.name}' was loading, a newer request was carried out"
            )
        try:
            self._workbench.check_startable(wanted.name)
            self._loop.set_controller(wanted.name, controller)
        except Exception as error:  # a fault since, a calibration, or parameters that it has lost
            self._dispose(controller)
            raise _refusal(wanted.name, "cannot start", error) from error
        return self._state()

    async def _load(self, wanted: protocol.SetController) -> Controller[Any]:
        create = partial(registry.create, wanted.name, wanted.parameters, self._loop.limits)
        try:
            return await self._asides.call(f"'{wanted.name}' has not loaded", create, late=_close)
        except Exception as error:
            raise _refusal(wanted.name, "cannot start", error) from error

    async def _set_parameter(self, wanted: protocol.SetParameter) -> State:
        loop = self._loop
        loop.supervisor.check_startable()
        if loop.supervisor.mode is not Mode.RUNNING:
            raise Refused(
                "not-running",
                f"no controller is running (mode {loop.supervisor.mode}); "
                "start one with 'fishctl set-controller'",
            )
        try:
            loop.retune(contained(self._retuned, wanted.parameters))
        except Exception as error:
            raise _refusal(loop.controller_name, "refused", error) from error
        return self._state()

    def _retuned(self, values: dict[str, Any]) -> Struct:
        loop = self._loop
        for field in fields_of(type(loop.controller.parameters)):
            if field.file and field.name in values:  # no tick waits for a file
                raise ParameterError(_why_not_in_flight(loop.controller_name, field.name))
        return registry.merged(loop.controller, loop.controller_name, values)

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

    def _dispose(self, controller: Controller[Any]) -> None:
        """Close a controller that was never in command, which may take its time."""
        self._asides.dispose(partial(_close, controller))

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
            parameters=loop.parameters,
        )


def _close(controller: Controller[Any]) -> None:
    try:
        contained(controller.close)
    except Exception as error:
        log.error("a controller that was not wanted any more could not be closed", exc_info=error)


def _refusal(name: str, what: str, error: Exception) -> Refused:
    """What a client is told when a controller cannot be had."""
    if isinstance(error, Refused):
        return error
    if isinstance(error, UnknownController):
        return Refused("unknown-controller", text.said(error))
    if isinstance(error, ParameterError):
        return Refused("bad-parameter", text.said(error))
    return Refused("controller-error", f"controller '{name}' {what}: {text.named(error)}")


def _why_not_in_flight(controller: str, parameter: str) -> str:
    return (
        f"{controller}: {parameter}: it cannot change in flight; start the controller again: "
        f"'fishctl set-controller {controller} --{parameter.replace('_', '-')} …'"
    )
