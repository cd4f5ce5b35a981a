"""A session of an experiment on the fish of a running fishd, or on a simulated fish."""

import logging
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from typing import TYPE_CHECKING, Any, Self

import msgspec

from fishd.client import Fish
from fishd.client.lease import LeaseRenewal
from fishd.config import Config, ServoSettings, adopt, check_tethered
from fishd.core import text
from fishd.core.calibration import EXACT, ForceCalibration
from fishd.core.errors import (
    ConfigError,
    FishdError,
    LeaseLost,
    ParameterError,
    PolicyError,
    Refused,
    UnknownController,
)
from fishd.core.robots import find_kind
from fishd.core.signals import Event, Publisher, Reason, Tick
from fishd.lab.simulation import VirtualRun

if TYPE_CHECKING:
    from fishd.lab.fin_angle import FinAngles
    from fishd.recording.provenance import Source
    from fishd.recording.writer import RunWriter

log = logging.getLogger(__name__)

Swim = Callable[[], list[Tick]]
Logged = Callable[[str, Mapping[str, Any], float, Swim], list[Tick]]
"""Function that returns the ticks of a swim of a controller with these parameters, and this
duration [s]: those that it has, or else those of `Swim`. A rest has no controller."""

IDLE_LIMIT = 5.0
"""Time after which an experiment that reads no tick while the fish swims counts as hung [s]."""
MAX_LOST_FRACTION = 0.02
"""Largest fraction of its ticks that a measurement may lose."""
FLUSH_INTERVAL_S = 0.5
"""Interval at which a recording is handed to the kernel: a kill loses no more than this [s]."""


class Disturbed(FishdError):
    """The fish did not do what the experiment requested; the message says what it did."""


class Replaced(Disturbed):
    """The controller gave up and its fallback took over, which the experiment did not request."""


_CONTROLLER_ERRORS = ("bad-parameter", "controller-error", "too-slow", "unknown-controller")


def concerns_one_controller(error: FishdError) -> bool:
    """Return whether an error concerns one controller only, so that the next one may swim."""
    if isinstance(error, Refused):
        return error.code in _CONTROLLER_ERRORS
    return isinstance(error, Replaced | ParameterError | PolicyError | UnknownController)


def refuse_lost(ticks: Sequence[Tick], lengths: Iterable[float], tick: float) -> None:
    """Raise `Disturbed` where too many of the ticks of a measurement did not arrive.

    lengths: of its swims and rests [s]; tick: period of the loop [s]
    """
    expected = sum(_count(length, tick) for length in lengths)
    lost = expected - len(ticks)
    if lost > MAX_LOST_FRACTION * expected:
        raise Disturbed(
            f"{lost} of {expected} ticks were lost on their way from fishd, more than "
            f"{MAX_LOST_FRACTION:.0%}: this measurement is lost"
        )


def _count(seconds: float, tick: float) -> int:
    return max(1, round(seconds / tick))


class Session(ABC):
    """One fish under the control of an experiment; a context manager that leaves it at rest."""

    name: str
    """Name of the robot, such as `simulated` or `pi`."""
    tick: float
    """Period of its loop [s]."""
    amplitude: float
    """Φ [rad]"""
    unit: str
    """Unit of its forces: `N`, or that of the sensor until it is calibrated."""
    calibration: ForceCalibration
    """Calibration of its force sensor, for how well the gains are known."""
    servo: ServoSettings | None = None
    """Calibrated settings of its servo; None where commands need no pulses, or where its driver
    is unknown here."""
    source: "Source"
    """Source of the ticks, as a recording names it."""
    config: dict[str, Any]
    """Configuration of its loop, as plain data."""
    fin_angles: "FinAngles | None" = None
    """Fin angles of a camera, which are recorded, too; None without one."""

    def __init__(self) -> None:
        self._listeners: list[Publisher] = []
        self._log: Logged | None = None
        self._finished = self._elapsed = self._planned = 0.0

    @property
    def used(self) -> float:
        """Tank time used by now, that of interrupted swims included [s]."""
        return self._finished + self._elapsed

    def __enter__(self) -> Self:
        """Return the session; nothing moves yet."""
        return self

    def read_config(self) -> Config:
        """Return the configuration of its loop."""
        return adopt(deepcopy(self.config))  # adopt modifies its argument

    def check_calibrated(self) -> None:
        """Raise `FishdError` where its forces are not in newtons."""
        if self.unit != "N":
            raise FishdError(
                "the force sensor is not calibrated, so forces are not in newtons; "
                "run 'fishctl calibrate force'"
            )

    @abstractmethod
    def __exit__(self, *exception: Any) -> None:
        """Leave the fish at rest."""

    @abstractmethod
    def describe(self, writer: "RunWriter") -> None:
        """Write the source and settings of the ticks to a recording; raises `RecordingError`."""

    @abstractmethod
    def _swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """Implement `swim`."""

    @abstractmethod
    def _rest(self, seconds: float) -> list[Tick]:
        """Implement `rest`."""

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """Swim a controller from its start for `seconds`; return the ticks of that time, in order.

        Raises `Refused` for a controller that fishd rejects, `Disturbed`, and `NoDaemon`.
        """
        return self._find_or_swim(
            controller, parameters, seconds, lambda: self._swim(controller, parameters, seconds)
        )

    def rest(self, seconds: float) -> list[Tick]:
        """Fade to neutral and stay there for `seconds`; return the ticks of that time, in order.

        Raises `Disturbed` and `NoDaemon`.
        """
        return self._find_or_swim("", {}, seconds, lambda: self._rest(seconds))

    def _find_or_swim(
        self,
        controller: str,
        parameters: Mapping[str, Any],
        seconds: float,
        swim: Swim,
    ) -> list[Tick]:
        """Swim or rest, unless the log of a resumed experiment has these ticks.

        The tank time grows by `seconds`; after an exception, only by the part that passed.
        """
        self._elapsed, self._planned = 0.0, seconds
        try:
            log = self._log
            ticks = log(controller, parameters, seconds, swim) if log else swim()
            self._elapsed = seconds
        finally:
            self._finished, self._elapsed = self.used, 0.0
        return ticks

    @contextmanager
    def heard_by(self, listener: Publisher) -> Iterator[None]:
        """Pass each tick and event to a listener while this lasts; its exceptions end a swim."""
        self._listeners.append(listener)
        try:
            yield
        finally:
            self._listeners.remove(listener)

    @contextmanager
    def logged(self, log: Logged) -> Iterator[None]:
        """Pass swims and rests through `log`, as `SwimLog.swim`, while this lasts."""
        self._log = log
        try:
            yield
        finally:
            self._log = None

    @contextmanager
    def recorded(
        self, path: str | os.PathLike[str], note: str, extra: Mapping[str, str] | None = None
    ) -> "Iterator[RunWriter]":
        """Record every tick and event while this lasts.

        The recording is kept after an exception too, unless it has no tick.

        path: path of the finished file; note, extra: see `RunWriter`
        Raises `RecordingError`, also later where a tick cannot be written, and `NoDaemon`.
        """
        from fishd.recording.writer import RunWriter

        with RunWriter(os.fspath(path), source=self.source, note=note, extra=extra) as writer:
            self.describe(writer)
            with self.heard_by(_Flushing(writer, self.fin_angles)):
                yield writer

    def _publish(self, message: Tick | Event) -> None:
        """Count a tick, and pass a tick or an event to the listeners."""
        if isinstance(message, Tick):
            self._elapsed = min(self._planned, self._elapsed + self.tick)
            for listener in self._listeners:
                listener.tick(message)
        else:
            for listener in self._listeners:
                listener.event(message)


class _Flushing:
    """Publisher that writes ticks, events and fin angles into a recording, and flushes it."""

    def __init__(self, writer: "RunWriter", fin_angles: "FinAngles | None") -> None:
        self._writer, self._fin_angles = writer, fin_angles
        self._flushed = time.monotonic()

    def tick(self, tick: Tick) -> None:
        self._writer.tick(tick)
        for tail in self._fin_angles.take_new() if self._fin_angles else ():
            self._writer.tail(tail)
        now = time.monotonic()
        if now - self._flushed >= FLUSH_INTERVAL_S:
            self._flushed = now
            self._writer.flush()

    def event(self, event: Event) -> None:
        self._writer.event(event)


class VirtualSession(Session):
    """A session on a simulated fish in virtual time."""

    def __init__(self, config: Config, calibration: ForceCalibration | None = None) -> None:
        """calibration: of the force sensor; by default the saved one, else an exact one"""
        super().__init__()
        check_tethered(config.robot, "a measurement of thrust")
        self.name = "simulation"
        self.tick = config.tick
        self.amplitude = config.amplitude_limit
        self.source: Source = "simulation"
        self.config = msgspec.to_builtins(config)
        self._queue = _MessageQueue()
        self._run = VirtualRun(config, self._queue)
        robot = self._run.loop.robot
        if calibration and robot.tared:
            robot.tared.recalibrate(calibration)
        saved = robot.calibrated.sensor.calibration if robot.calibrated else EXACT
        self.calibration = calibration or saved
        self.unit = robot.force_unit
        if robot.calibrated:
            self.servo = config.servo.calibrated(robot.calibrated.servo.calibration)

    def describe(self, writer: "RunWriter") -> None:
        """Write the configuration and the robot to a recording."""
        writer.describe(self._run.config, self._run.about(), self._run.readings)

    def __exit__(self, *exception: Any) -> None:
        self._run.close()

    def _swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        self._run.set_controller(controller, parameters)
        return self._collect_ticks(seconds, controller)

    def _rest(self, seconds: float) -> list[Tick]:
        self._run.loop.stop()
        return self._collect_ticks(seconds, None)

    def _collect_ticks(self, seconds: float, controller: str | None) -> list[Tick]:
        ticks: list[Tick] = []
        for _ in range(_count(seconds, self.tick)):
            self._run.tick()
            for message in self._queue.take_all():
                self._publish(message)
                if isinstance(message, Tick):
                    ticks.append(message)
            loop = self._run.loop
            _check(ticks[-1], controller, loop.supervisor.reason, loop.active.fallback)
        return ticks


class LiveSession(Session):
    """A session on the fish of a running fishd; while it is entered, it holds the lease.

    Ticks that are lost on the way from fishd are missing in the returned lists.
    """

    def __init__(self, fish: Fish, experiment: str = "experiment", take: bool = False) -> None:
        """
        experiment: name of the lease, which `fishctl status` shows
        take: take the fish from another experiment

        Raises `NoDaemon`, `Refused` while another experiment holds the fish, and `ConfigError`
        for a free fish.
        """
        super().__init__()
        status = fish.status()
        if status.lease and not take:
            raise Refused("leased", status.lease.refusal())
        check_tethered(status.robot, "a measurement of thrust")
        self.name = status.robot
        self.unit = status.force_unit
        has_hardware = find_kind(status.robot).has_hardware
        calibrations = fish.calibrations() if has_hardware else None
        self.calibration = calibrations.force if calibrations else EXACT
        self.tick = status.tick
        self.amplitude = status.amplitude_limit
        self.source: Source = "fishd"
        self.config = fish.config()
        if calibrations:
            with suppress(ConfigError):  # its driver may not be installed on this machine
                self.servo = self.read_config().servo.calibrated(calibrations.servo)
        self.fish = fish
        self._messages = fish.ticks_and_events()
        self._first_status = status
        self._latest = 0
        """Number of the latest received tick."""
        self._lease = fish.lease(experiment, take=take, idle_limit=IDLE_LIMIT)
        self._held: LeaseRenewal

    def describe(self, writer: "RunWriter") -> None:
        """Write the facts about fishd to a recording; raises also `NoDaemon`."""
        from fishd.recording.recorder import describe_daemon

        describe_daemon(self.fish).write(writer)

    def __enter__(self) -> Self:
        """Take the lease; raises `Refused` while another experiment holds the fish."""
        self._held = self._lease.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        """Release the lease, with the fish at rest; leave a fish that another client took."""
        self._lease.__exit__(*exception)

    def _swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        with _lease_loss_as_disturbed():
            state = self.fish.set_controller(controller, **parameters)
            return self._collect_ticks(state.seq, seconds, controller)

    def _rest(self, seconds: float) -> list[Tick]:
        with _lease_loss_as_disturbed():
            return self._collect_ticks(self.fish.stop().seq, seconds, None)

    def _collect_ticks(self, first: int, seconds: float, controller: str | None) -> list[Tick]:
        ticks: list[Tick] = []
        end = first + _count(seconds, self.tick)
        if first <= self._latest:
            raise _restarted()
        for tick in self._messages:
            self._publish(tick)
            if not isinstance(tick, Tick):
                if ticks and controller and tick.kind in ("parameters", "controller"):
                    self.fish.renew_lease(
                        self._held.token
                    )  # raises the reason if the lease has ended
                    raise Disturbed(
                        f"another client changed the controller: {text.line(tick.message)}: this "
                        "measurement is lost"
                    )
                continue
            self._check_same_fishd(tick)
            if tick.seq < first:
                continue
            if not _is_as_requested(tick, controller):
                status = self.fish.status()
                if not (status.reason or status.fallback):
                    self.fish.renew_lease(
                        self._held.token
                    )  # raises the reason if the lease has ended
                _check(tick, controller, status.reason, status.fallback)
            if tick.seq < end:
                ticks.append(tick)
            if tick.seq >= end - 1:
                break
        if not ticks:
            refuse_lost(ticks, (seconds,), self.tick)
        if lost := end - first - len(ticks):
            log.warning("ticks of this experiment lost on their way from fishd: %d", lost)
        return ticks

    def _check_same_fishd(self, tick: Tick) -> None:
        """Raise `Disturbed` where fishd was restarted before this tick."""
        before, self._latest = self._latest, tick.seq
        if tick.seq <= before:
            raise _restarted()
        # A fishd that restarted soon after its start may have passed that tick number meanwhile.
        is_gap = before and tick.seq > before + 1
        if is_gap and self.fish.status().shows_restart_since(self._first_status):
            raise _restarted()


@contextmanager
def _lease_loss_as_disturbed() -> Iterator[None]:
    """Raise `Disturbed` in place of `LeaseLost`."""
    try:
        yield
    except LeaseLost as error:
        raise Disturbed(f"{text.error_message(error)}: this measurement is lost") from None


def _restarted() -> Disturbed:
    return Disturbed("fishd was restarted: this measurement is lost")


class _MessageQueue:
    """A publisher that stores ticks and events in order until they are taken."""

    def __init__(self) -> None:
        self._messages: list[Tick | Event] = []

    def tick(self, tick: Tick) -> None:
        self._messages.append(tick)

    def event(self, event: Event) -> None:
        self._messages.append(event)

    def take_all(self) -> list[Tick | Event]:
        """Return the stored messages and remove them."""
        messages, self._messages = self._messages, []
        return messages


def _is_as_requested(tick: Tick, controller: str | None) -> bool:
    """Return whether a controller swims; for None, whether the fish rests."""
    if controller is None:
        return tick.mode == "idle"
    return (tick.mode, tick.controller) == ("running", controller)


def _check(
    tick: Tick, controller: str | None, reason: Reason | None, fallback: Reason | None
) -> None:
    """Raise `Disturbed` where the fish does not do what the experiment requested.

    reason: reason of mode fault or estop; fallback: reason why another controller took over
    """
    if _is_as_requested(tick, controller):
        return
    request = f"to swim {controller}" if controller else "to rest"
    cause = reason or fallback
    why = f" ({cause.message})" if cause else ""
    state = f"{tick.controller} swims" if tick.mode == "running" else f"it is in mode {tick.mode}"
    replaced = controller and fallback and tick.mode == "running"
    kind = Replaced if replaced else Disturbed
    raise kind(f"the fish was {request}, but {state}{why}: this measurement is lost")
