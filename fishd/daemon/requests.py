"""Operations of the control protocol on the loop of a running daemon."""

import logging
import os
import socket
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from msgspec import Struct

from fishd import __version__
from fishd.config import Config
from fishd.control.lease import RETURN_REASON
from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.controllers import registry
from fishd.controllers.base import Controller, Limits
from fishd.controllers.policy import library
from fishd.core import protocol, text
from fishd.core.clock import Clock, SlowClock, read_boot_id
from fishd.core.errors import ConfigError, ParameterError, Refused, UnknownController
from fishd.core.foreign_code import call_foreign
from fishd.core.protocol import Grant, PolicyInfo, State
from fishd.core.schema import Problem, convert, fields_of, suggest
from fishd.core.signals import ControllerInfo, LeaseHolder, Status
from fishd.daemon.background_calls import BackgroundCalls
from fishd.daemon.calibration_requests import CalibrationRequests, Handlers

log = logging.getLogger(__name__)


class Access(NamedTuple):
    """How clients reach fishd now."""

    control: str = ""
    """Address of the control socket; empty without one."""
    telemetry: str = ""
    keyed_telemetry: str = ""
    """Address of telemetry for clients with a key; empty for none."""
    limitation: str | None = None
    """Line about what is wrong with the sockets; None if nothing is."""
    counters: Mapping[str, int] = {}
    """Numbers of recovered errors since start."""


class Restart(NamedTuple):
    """How fishd is started again by systemd."""

    check_config: Callable[[], object]
    """Function that reads all that its start will read; it raises `ConfigError`."""
    end: Callable[[], None]
    """Function that lets it end for that."""


class Operations:
    """Handlers of the requests, which read the loop's state and change it between its ticks."""

    def __init__(
        self,
        loop: ControlLoop,
        clock: Clock,
        calibration_requests: CalibrationRequests,
        config: Config,
        controllers: list[ControllerInfo],
        realtime: bool,
        access: Callable[[], "Access"] = Access,
        restart: "Callable[[], Restart | None]" = lambda: None,
    ) -> None:
        """Prepare to answer requests.

        config: configuration that fishd was started with
        controllers: controllers that can be made active
        realtime: whether the loop runs under SCHED_FIFO
        access: function that returns how clients reach this fishd
        restart: function that returns how systemd starts it again; None if it does not
        """
        self._loop = loop
        self._clock = clock
        self._realtime = realtime
        self._find_restart = restart
        self._access = access
        self._calibrations = calibration_requests
        self._config = config
        self._name = config.name or text.line(socket.gethostname(), 40) or "fish"
        self._monotonic = time.monotonic if isinstance(clock, SlowClock) else clock.monotonic
        self._started = self._monotonic()
        self._boot = read_boot_id()
        self._arrivals = 0
        """Number of requests since start that choose the controller."""
        self._carried_out = 0
        """Number of the newest of them that was carried out."""
        self._calls = BackgroundCalls(protocol.LOADING_TIMEOUT_S)
        self._controllers = controllers
        self._handlers: Handlers = {
            "status": self._status,
            "controllers": self._list_controllers,
            "policies": self._list_policies,
            "config": self._get_config,
            "set-controller": self._set_controller,
            "set-parameter": self._set_parameter,
            "stop": self._stop,
            "estop": self._estop,
            "clear-fault": self._clear_fault,
            "restart": self._restart,
            "take-lease": self._take_lease,
            "renew-lease": self._renew_lease,
            "end-lease": self._end_lease,
            "mark": self._mark,
            **calibration_requests.handlers,
            "calibrate-thrust": self._calibrate_thrust,
        }

    async def perform(self, op: str, args: dict[str, Any]) -> Any:
        """Carry out a request and return its result; raise `Refused` if that is not possible."""
        if op not in self._handlers:
            hint = suggest(op, list(self._handlers))
            raise Refused("unknown-op", f"no such op '{text.quoted(op)}'; {hint}")
        try:
            arguments: Any = convert(args, protocol.OPERATIONS[op].arguments)
        except Problem as problem:
            path = text.quoted(".".join(problem.path))
            raise Refused("bad-arguments", f"{op}: {path}: {problem}") from None
        return await self._handlers[op](arguments)

    def status(self) -> Status:
        """Return a snapshot of the daemon's state."""
        loop, access = self._loop, self._access()
        observation = loop.perception.observation
        thrust, error = loop.perception.known_thrust
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
            thrust_ci95=error,
            frequency=observation.frequency if observation else 0.0,
            tick=loop.limits.tick,
            amplitude_limit=loop.limits.amplitude,
            lowest_angle=loop.guard.lowest,
            highest_angle=loop.guard.highest,
            seq=loop.seq,
            missed_slots=loop.statistics.missed,
            overruns=loop.statistics.overruns,
            timing=loop.statistics.timing(),
            robot=loop.robot.name,
            limitations=(*self._limitations(), *filter(None, [access.limitation])),
            recovered_errors={**loop.robot.counters(), **access.counters},
            realtime=self._realtime,
            telemetry=access.telemetry,
            servo_lost=loop.servo.lost,
            fallback=loop.active.fallback,
            sensor_lost=loop.supervisor.sensor_lost,
            calibrating=self._calibrations.calibrating,
            name=self._name,
            phi_c=loop.instruction_angle,
            force_unit=loop.robot.force_unit,
            quantities=loop.active.quantities,
            quantity_units=loop.active.quantity_units,
            clock=self._clock.monotonic(),
            boot_id=self._boot,
            speed=self._speed(),
            readings=loop.readings.states(self._clock.monotonic()),
            fy_reversed=loop.perception.lateral_sign.reversed,
            leak=loop.perception.found_leak,
            lease=loop.lease.holder,
            lease_expiry=loop.lease.expired,
            keyed_telemetry=access.keyed_telemetry,
            control=access.control,
        )

    def _limitations(self) -> tuple[str, ...]:
        loop = self._loop
        return (
            *loop.robot.limitations(),
            *loop.readings.troubles.values(),
            *filter(None, [loop.perception.lateral_sign.complaint]),
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
        describe = partial(library.describe_all, self._loop.limits)
        return await self._calls.call("the policy files have not been read", describe)

    async def _get_config(self, _: protocol.NoArguments) -> Config:
        return self._config

    async def _set_controller(self, request: protocol.SetController) -> State:
        self._loop.supervisor.check_startable()  # before loading it in vain
        self._calibrations.check_startable(request.name, request.lease)
        self._renew(request.lease)
        self._calls.check_busy()
        arrival = self._next_arrival()
        controller = await self._load(request)
        if arrival < self._carried_out:  # a slow request must not undo a newer one
            self._dispose(controller)
            raise Refused(
                "superseded", f"while '{request.name}' was loading, a newer request was carried out"
            )
        try:
            self._calibrations.check_startable(request.name, request.lease)
            self._renew(request.lease)
            self._loop.set_controller(request.name, controller)
        except Exception as error:  # such as a fault or a calibration since, or missing parameters
            self._dispose(controller)
            raise _refusal(request.name, "cannot start", error) from error
        self._carried_out = arrival
        self._loop.lease.drives = True
        return self._state(self._end_unless(request.lease, f"{request.name} was set by hand"))

    def _renew(self, lease: str | None) -> None:
        """Renew the lease that a request names; raise `Refused` if it has ended."""
        if lease is not None:
            self._loop.lease.renew(lease)

    def _end_unless(self, lease: str | None, why: str) -> LeaseHolder | None:
        """End the present lease for a request without a lease; return the lease's former holder."""
        if lease is not None:
            return None
        former = self._loop.lease.end(why)
        if former:
            self._announce("lost", former, f"{former} has lost the fish: {why}")
        return former

    def _announce(self, what: str, holder: LeaseHolder, message: str) -> None:
        name, host, pid = holder.name, holder.host, holder.pid
        self._loop.reporter.event("lease", message, lease=what, name=name, host=host, pid=pid)

    async def _take_lease(self, request: protocol.TakeLease) -> Grant:
        loop = self._loop
        loop.supervisor.check_startable()
        if not request.take:
            loop.lease.check_free()
        former = self._end_unless(None, f"{request.name} took the fish")
        if former and loop.lease.drives:
            loop.stop()
        seconds = request.seconds or self._config.control.lease
        token = loop.lease.take(request.name, request.host, request.pid, seconds)
        if holder := loop.lease.holder:
            self._announce("taken", holder, f"{holder} takes the fish")
        return Grant(token, seconds, former)

    async def _renew_lease(self, request: protocol.HeldLease) -> State:
        self._loop.lease.renew(request.lease)
        return self._state()

    async def _end_lease(self, request: protocol.HeldLease) -> State:
        self._loop.lease.renew(request.lease)
        self._carried_out = self._next_arrival()
        former = self._loop.lease.end(RETURN_REASON)
        if self._loop.lease.drives:
            self._loop.stop()
        if former:
            self._announce("returned", former, f"{former} gives the fish back")
        return self._state()

    async def _load(self, request: protocol.SetController) -> Controller[Any]:
        create = partial(_create, request.name, request.parameters, self._loop.limits)
        try:
            return await self._calls.call(f"'{request.name}' has not loaded", create, late=_close)
        except Exception as error:
            raise _refusal(request.name, "cannot start", error) from error

    async def _set_parameter(self, request: protocol.SetParameter) -> State:
        loop = self._loop
        loop.supervisor.check_startable()
        self._calibrations.check_startable(loop.active.name, request.lease)
        self._renew(request.lease)
        if loop.supervisor.mode is not Mode.RUNNING:
            raise Refused(
                "not-running",
                f"no controller is running (mode {loop.supervisor.mode}); "
                "start one with 'fishctl set-controller'",
            )
        try:
            loop.active.retune(call_foreign(self._merge_parameters, request.parameters))
        except Exception as error:
            raise _refusal(loop.active.name, "refused", error) from error
        return self._state()

    def _merge_parameters(self, values: dict[str, Any]) -> Struct:
        loop = self._loop
        for field in fields_of(loop.active.controller.Parameters):
            if field.file and field.name in values:  # a tick must not wait for a file
                name, option = loop.active.name, field.name.replace("_", "-")
                raise ParameterError(
                    f"{name}: {field.name}: it cannot change while {name} is active; start the "
                    f"controller again: 'fishctl set-controller {name} --{option} …'"
                )
        return registry.merge_parameters(loop.active.controller, loop.active.name, values)

    async def _stop(self, request: protocol.Stop) -> State:
        self._renew(request.lease)
        self._carried_out = self._next_arrival()
        former = self._end_unless(request.lease, "the fish was stopped by hand")
        cancelled = self._loop.pending
        self._loop.stop()
        return self._state(former, cancelled)

    async def _estop(self, request: protocol.Estop) -> State:
        self._carried_out = self._next_arrival()
        self._loop.estop(request.message)
        return self._state()

    async def _clear_fault(self, _: protocol.NoArguments) -> State:
        self._carried_out = self._next_arrival()
        self._loop.clear_fault()
        return self._state()

    async def _restart(self, _: protocol.NoArguments) -> State:
        systemd = self._find_restart()
        if systemd is None:
            raise Refused(
                "no-service",
                "fishd is not a service of systemd, which would start it again; end it and start "
                "it by hand",
            )
        self._check_may_end()
        self._calls.check_busy()
        try:
            await self._calls.call("the configuration has not been read", systemd.check_config)
        except ConfigError as error:
            raise Refused("bad-configuration", text.error_message(error)) from None
        self._check_may_end()
        systemd.end()
        return self._state()

    def _check_may_end(self) -> None:
        """Raise `Refused` while a program has or drives the fish, or an E-stop is latched."""
        loop = self._loop
        loop.lease.check_free()
        if loop.supervisor.mode is Mode.RUNNING:
            raise Refused(
                "running", f"{loop.active.name} drives the fish; first stop it with 'fishctl stop'"
            )
        if loop.supervisor.mode is Mode.ESTOP:
            raise Refused(
                "estop", "a restart would end the emergency stop; use 'fishctl clear-fault' first"
            )

    async def _mark(self, request: protocol.Mark) -> State:
        self._loop.reporter.event("mark", request.text)
        return self._state()

    async def _calibrate_thrust(self, request: protocol.CalibrateThrust) -> State:
        self._loop.perception.thrust.calibrate(request.factor, request.factor_ci95)
        return self._state()

    def _dispose(self, controller: Controller[Any]) -> None:
        """Close a controller that was never active, in a thread."""
        self._calls.dispose(partial(_close, controller))

    def _next_arrival(self) -> int:
        """Return a number for a request that chooses the controller."""
        self._arrivals += 1
        return self._arrivals

    def _state(
        self, previous_holder: LeaseHolder | None = None, cancelled: str | None = None
    ) -> State:
        loop = self._loop
        return State(
            seq=loop.seq + 1,
            mode=loop.supervisor.mode.value,
            reason=loop.supervisor.reason,
            controller=loop.active.name,
            parameters=loop.active.parameters,
            previous_holder=previous_holder,
            cancelled=cancelled,
        )


_TRIAL_TIMEOUT_S = 0.8 * protocol.LOADING_TIMEOUT_S
"""Longest time that a package may take in its trial, so that the reason is said in time [s]."""


def _create(name: str, values: Mapping[str, Any], limits: Limits) -> Controller[Any]:
    registry.try_import(name, _TRIAL_TIMEOUT_S)
    return registry.create(name, values, limits)


def _close(controller: Controller[Any]) -> None:
    try:
        call_foreign(controller.close)
    except Exception as error:
        log.error("a controller that is no longer needed could not be closed", exc_info=error)


def _refusal(name: str, what: str, error: Exception) -> Refused:
    """Return the refusal for an error of creating or starting a controller."""
    if isinstance(error, Refused):
        return error
    if isinstance(error, UnknownController):
        return Refused("unknown-controller", text.error_message(error))
    if isinstance(error, ParameterError):
        return Refused("bad-parameter", text.error_message(error))
    return Refused("controller-error", f"controller '{name}' {what}: {text.describe_error(error)}")
