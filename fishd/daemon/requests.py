"""What can be asked of a running daemon: each operation of the control protocol, over one loop."""

import logging
import os
import socket
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from msgspec import Struct

from fishd import __version__
from fishd.config import Config
from fishd.control.lease import RETURN_REASON
from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.controllers import registry
from fishd.controllers.base import Controller
from fishd.controllers.policy import library
from fishd.core import protocol, text
from fishd.core.clock import Clock, SlowClock, boot_id
from fishd.core.errors import ParameterError, Refused, UnknownController
from fishd.core.foreign_code import contained
from fishd.core.protocol import Grant, PolicyInfo, State
from fishd.core.schema import Problem, convert, fields_of, nearest
from fishd.core.signals import ControllerInfo, LeaseHolder, Status
from fishd.daemon.background_calls import BackgroundCalls
from fishd.daemon.calibration_requests import CalibrationRequests, Handlers

log = logging.getLogger(__name__)


class Operations:
    """Answers requests from what the loop knows, and makes changes between its ticks."""

    def __init__(
        self,
        loop: ControlLoop,
        clock: Clock,
        calibration_requests: CalibrationRequests,
        config: Config,
        controllers: list[ControllerInfo],
        telemetry: str,
        realtime: bool,
        counters: Callable[[], dict[str, int]] = dict,
    ) -> None:
        """
        config: what fishd was started with
        controllers: all that can be made active
        telemetry: the address that clients are told
        realtime: does the loop run under SCHED_FIFO?
        counters: what was survived outside of the robot, since start
        """
        self._loop = loop
        self._clock = clock
        self._telemetry = telemetry
        self._realtime = realtime
        self._counters = counters
        self._calibrations = calibration_requests
        self._config = config
        self._name = config.name or text.line(socket.gethostname(), 40) or "fish"
        self._monotonic = time.monotonic if isinstance(clock, SlowClock) else clock.monotonic
        self._started = self._monotonic()
        self._boot = boot_id()
        self._arrivals = 0
        """How many requests have come that choose the controller."""
        self._carried_out = 0
        """The newest of them that was carried out."""
        self._calls = BackgroundCalls(protocol.LOADING)
        self._controllers = controllers
        self._at_start = set(registry.names())
        self._handlers: Handlers = {
            "status": self._status,
            "controllers": self._list_controllers,
            "policies": self._list_policies,
            "config": self._tell_config,
            "set-controller": self._set_controller,
            "set-parameter": self._set_parameter,
            "stop": self._stop,
            "estop": self._estop,
            "clear-fault": self._clear_fault,
            "take-lease": self._take_lease,
            "renew-lease": self._renew_lease,
            "end-lease": self._end_lease,
            "mark": self._mark,
            **calibration_requests.handlers,
            "calibrate-thrust": self._calibrate_thrust,
        }

    async def perform(self, op: str, args: dict[str, Any]) -> Any:
        """Do what a request asks for and return its result; raises `Refused`."""
        if op not in self._handlers:
            hint = nearest(op, list(self._handlers))
            raise Refused("unknown-op", f"no such op '{text.quoted(op)}'; {hint}")
        try:
            arguments: Any = convert(args, protocol.OPERATIONS[op].arguments)
        except Problem as problem:
            path = text.quoted(".".join(problem.path))
            raise Refused("bad-arguments", f"{op}: {path}: {problem}") from None
        return await self._handlers[op](arguments)

    def status(self) -> Status:
        """The daemon in one snapshot."""
        loop = self._loop
        observation = loop.observation
        thrust, error = loop.known_thrust
        return Status(
            t=self._clock.wall(),
            version=__version__,
            pid=os.getpid(),
            uptime=self._monotonic() - self._started,
            mode=loop.supervisor.mode.value,
            reason=loop.supervisor.reason,
            controller=loop.active.name,
            parameters=loop.active.parameters,
            servo_on=loop.servo.on,
            thrust=thrust,
            thrust_error=error,
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
            degraded=self._degraded(),
            counters={**loop.robot.counters(), **self._counters()},
            realtime=self._realtime,
            telemetry=self._telemetry,
            servo_lost=loop.servo.lost,
            fallback=loop.active.fallback,
            sensor_lost=loop.supervisor.sensor_lost,
            calibrating=self._calibrations.calibrating,
            name=self._name,
            phi_c=loop.applied,
            force_unit=loop.robot.force_unit,
            quantities=loop.active.quantities,
            quantity_units=loop.active.quantity_units,
            clock=self._clock.monotonic(),
            boot=self._boot,
            speed=self._speed(),
            power=loop.power.mean,
            fy_reversed=loop.lateral_sign.reversed,
            leak=loop.found_leak,
            lease=loop.lease.holder,
            lease_expired=loop.lease.expired,
        )

    def _degraded(self) -> tuple[str, ...]:
        loop = self._loop
        return (
            *loop.robot.degraded(),
            *filter(None, [loop.power.trouble, loop.lateral_sign.complaint]),
        )

    def _speed(self) -> float | None:
        truth = self._loop.robot.truth
        course = truth().course if truth else None
        return course.speed if course else None

    async def _status(self, _: protocol.NoArguments) -> Status:
        return self.status()

    async def _list_controllers(self, _: protocol.NoArguments) -> list[ControllerInfo]:
        return self._controllers

    async def _list_policies(self, _: protocol.NoArguments) -> list[PolicyInfo]:
        self._calls.check_busy()
        limits = self._loop.limits
        describe = partial(library.describe_all, limits.tick, limits.amplitude)
        return await self._calls.call("the policy files have not been read", describe)

    async def _tell_config(self, _: protocol.NoArguments) -> Config:
        return self._config

    async def _set_controller(self, wanted: protocol.SetController) -> State:
        self._loop.supervisor.check_startable()  # before it is loaded in vain
        self._calibrations.check_startable(wanted.name, wanted.lease)
        self._renew(wanted.lease)
        self._calls.check_busy()
        arrival = self._arrive()
        controller = await self._load(wanted)
        if arrival < self._carried_out:  # one that loads slowly must not undo a newer one
            self._dispose(controller)
            raise Refused(
                "superseded", f"while '{wanted.name}' was loading, a newer request was carried out"
            )
        try:
            self._calibrations.check_startable(wanted.name, wanted.lease)
            self._renew(wanted.lease)
            self._loop.set_controller(wanted.name, controller)
        except Exception as error:  # a fault since, a calibration, or parameters that it has lost
            self._dispose(controller)
            raise _refusal(wanted.name, "cannot start", error) from error
        self._carried_out = arrival
        self._loop.lease.drives = True
        return self._state(self._end_unless(wanted.lease, f"{wanted.name} was set by hand"))

    def _renew(self, lease: str | None) -> None:
        """Renew the lease that a request names; raises `Refused` where it has ended."""
        if lease is not None:
            self._loop.lease.renew(lease)

    def _end_unless(self, lease: str | None, why: str) -> LeaseHolder | None:
        """End the lease that there is, where a request by hand names none; returns its holder."""
        if lease is not None:
            return None
        former = self._loop.lease.end(why)
        if former:
            self._announce("lost", former, f"{former} has lost the fish: {why}")
        return former

    def _announce(self, what: str, holder: LeaseHolder, message: str) -> None:
        name, host, pid = holder.name, holder.host, holder.pid
        self._loop.reporter.event("lease", message, lease=what, name=name, host=host, pid=pid)

    async def _take_lease(self, wanted: protocol.TakeLease) -> Grant:
        loop = self._loop
        loop.supervisor.check_startable()
        if not wanted.take:
            loop.lease.check_free()
        former = self._end_unless(None, f"{wanted.name} took the fish")
        if former and loop.lease.drives:
            loop.stop()
        seconds = wanted.seconds or self._config.control.lease
        token = loop.lease.take(wanted.name, wanted.host, wanted.pid, seconds)
        if holder := loop.lease.holder:
            self._announce("taken", holder, f"{holder} takes the fish")
        return Grant(token, seconds, former)

    async def _renew_lease(self, wanted: protocol.HeldLease) -> State:
        self._loop.lease.renew(wanted.lease)
        return self._state()

    async def _end_lease(self, wanted: protocol.HeldLease) -> State:
        self._loop.lease.renew(wanted.lease)
        self._carried_out = self._arrive()
        former = self._loop.lease.end(RETURN_REASON)
        if self._loop.lease.drives:
            self._loop.stop()
        if former:
            self._announce("returned", former, f"{former} gives the fish back")
        return self._state()

    async def _load(self, wanted: protocol.SetController) -> Controller[Any]:
        create = partial(registry.create, wanted.name, wanted.parameters, self._loop.limits)
        new = wanted.name not in self._at_start
        if new:
            create = partial(_create_newly_installed, wanted.name, create)
        try:
            found = await self._calls.call(f"'{wanted.name}' has not loaded", create, late=_close)
        except Exception as error:
            raise _refusal(wanted.name, "cannot start", error) from error
        if new and wanted.name not in (info.name for info in self._controllers):
            self._controllers.append(registry.describe(wanted.name))
            self._controllers.sort(key=lambda info: info.name)
        return found

    async def _set_parameter(self, wanted: protocol.SetParameter) -> State:
        loop = self._loop
        loop.supervisor.check_startable()
        self._calibrations.check_startable(loop.active.name, wanted.lease)
        self._renew(wanted.lease)
        if loop.supervisor.mode is not Mode.RUNNING:
            raise Refused(
                "not-running",
                f"no controller is running (mode {loop.supervisor.mode}); "
                "start one with 'fishctl set-controller'",
            )
        try:
            loop.active.retune(contained(self._retuned, wanted.parameters))
        except Exception as error:
            raise _refusal(loop.active.name, "refused", error) from error
        return self._state()

    def _retuned(self, values: dict[str, Any]) -> Struct:
        loop = self._loop
        for field in fields_of(loop.active.controller.Parameters):
            if field.file and field.name in values:  # no tick waits for a file
                name, option = loop.active.name, field.name.replace("_", "-")
                raise ParameterError(
                    f"{name}: {field.name}: it cannot change in flight; start the controller "
                    f"again: 'fishctl set-controller {name} --{option} …'"
                )
        return registry.merged(loop.active.controller, loop.active.name, values)

    async def _stop(self, wanted: protocol.Stop) -> State:
        self._renew(wanted.lease)
        self._carried_out = self._arrive()
        former = self._end_unless(wanted.lease, "the fish was stopped by hand")
        self._loop.stop()
        return self._state(former)

    async def _estop(self, wanted: protocol.Estop) -> State:
        self._carried_out = self._arrive()
        self._loop.estop(wanted.message)
        return self._state()

    async def _clear_fault(self, _: protocol.NoArguments) -> State:
        self._carried_out = self._arrive()
        self._loop.clear_fault()
        return self._state()

    async def _mark(self, wanted: protocol.Mark) -> State:
        self._loop.reporter.event("mark", wanted.text)
        return self._state()

    async def _calibrate_thrust(self, wanted: protocol.CalibrateThrust) -> State:
        self._loop.thrust.calibrate(wanted.factor, wanted.error)
        return self._state()

    def _dispose(self, controller: Controller[Any]) -> None:
        """Close a controller that was never active, which may take its time."""
        self._calls.dispose(partial(_close, controller))

    def _arrive(self) -> int:
        """The number of a request that chooses the controller."""
        self._arrivals += 1
        return self._arrivals

    def _state(self, took_from: LeaseHolder | None = None) -> State:
        loop = self._loop
        return State(
            seq=loop.seq + 1,
            mode=loop.supervisor.mode.value,
            reason=loop.supervisor.reason,
            controller=loop.active.name,
            parameters=loop.active.parameters,
            took_from=took_from,
        )


def _create_newly_installed(name: str, create: Callable[[], Controller[Any]]) -> Controller[Any]:
    """Create a controller that was not there when fishd started."""
    try:
        return create()
    except UnknownController as error:
        if name in registry.names():  # its package cannot be imported: a new folder to look in, say
            raise UnknownController(
                f"{text.said(error)}; it was installed after fishd had started: restart fishd"
            ) from error
        raise


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
