"""A fish that an experiment tells to swim and to rest: of a running fishd, or in virtual time."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol, Self

from fishd.client import Fish
from fishd.client.lease import LeaseRenewal
from fishd.config import Config, check_tethered
from fishd.control.reporting import Publisher
from fishd.core import text
from fishd.core.calibration import EXACT, ForceCalibration
from fishd.core.errors import (
    FishdError,
    LeaseLost,
    ParameterError,
    PolicyError,
    Refused,
    UnknownController,
)
from fishd.core.signals import Event, Reason, Tick
from fishd.lab.simulation import VirtualRun

if TYPE_CHECKING:
    from fishd.recording.provenance import Source
    from fishd.recording.writer import RunWriter

IDLE_LIMIT = 5.0
"""Time after which an experiment that reads no tick while the fish swims counts as hung [s]."""
LOST = 0.02
"""A measurement may miss this share of its ticks."""


class Disturbed(FishdError):
    """The fish did not do what the experiment told it to; the message says what it did."""


class Replaced(Disturbed):
    """The controller gave up and another one took over, which the experiment did not ask for."""


_OF_ONE = ("bad-parameter", "controller-error", "too-slow", "unknown-controller")


def is_of_one(error: FishdError) -> bool:
    """Does it concern one controller with its parameters only, so that the next one may swim?"""
    if isinstance(error, Refused):
        return error.code in _OF_ONE
    return isinstance(error, Replaced | ParameterError | PolicyError | UnknownController)


def refuse_lost(ticks: Sequence[Tick], lengths: Iterable[float], tick: float) -> None:
    """Raise `Disturbed` where too many of the ticks of a measurement did not arrive.

    lengths: of its swims and rests [s]; tick: period of the loop [s]
    """
    expected = sum(_count(length, tick) for length in lengths)
    lost = expected - len(ticks)
    if lost > LOST * expected:
        raise Disturbed(
            f"{lost} of {expected} ticks were lost on their way from fishd, more than {LOST:.0%}: "
            "this measurement is lost"
        )


def _count(seconds: float, tick: float) -> int:
    return max(1, round(seconds / tick))


class Rig(Protocol):
    """One fish, of which an experiment is in charge; a context manager that leaves it at rest."""

    name: str
    """What it is, such as `simulated` or `pi`."""
    tick: float
    """Period of its loop [s]."""
    amplitude: float
    """Φ [rad]"""
    unit: str
    """Of its forces: `N`, or that of its sensor until that is calibrated."""
    calibration: ForceCalibration
    """Calibration of its force sensor, for how well the gains are known."""
    source: "Source"
    """What a recording says of where its ticks are from."""
    listener: Publisher | None
    """Is given each tick and event as it comes, in order; what it raises ends a swim or a rest."""

    def describe(self, writer: "RunWriter") -> None:
        """Put what the ticks are made with into a recording; raises `RecordingError`."""

    def __enter__(self) -> Self:
        """Nothing moves yet."""

    def __exit__(self, *_: object) -> None:
        """Leave the fish at rest."""

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """Let a controller swim from its start for so long; the ticks of that time, in order.

        Raises `Refused` for a controller that is not possible, and `Disturbed`.
        """

    def rest(self, seconds: float) -> list[Tick]:
        """Fade to neutral and stay there for so long; the ticks of that time, in order.

        Raises `Disturbed`.
        """


class VirtualRig:
    """A simulated fish in virtual time."""

    def __init__(self, config: Config, calibration: ForceCalibration | None = None) -> None:
        """calibration: that of its force sensor; by default what was saved, else an exact one"""
        check_tethered(config.robot, "a measurement of thrust")
        self.name = "simulation"
        self.tick = config.tick
        self.amplitude = config.amplitude_limit
        self.source: Source = "simulation"
        self.listener: Publisher | None = None
        self._heard = _Heard()
        self._run = VirtualRun(config, self._heard)
        robot = self._run.loop.robot
        if calibration and robot.tared:
            robot.tared.recalibrate(calibration)
        saved = robot.calibrated.sensor.calibration if robot.calibrated else EXACT
        self.calibration = calibration or saved
        self.unit = robot.force_unit

    def describe(self, writer: "RunWriter") -> None:
        """As `Rig.describe`."""
        writer.describe(self._run.config, self._run.about())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._run.close()

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """As `Rig.swim`."""
        self._run.set_controller(controller, parameters)
        return self._pass(seconds, controller)

    def rest(self, seconds: float) -> list[Tick]:
        """As `Rig.rest`."""
        self._run.loop.stop()
        return self._pass(seconds, None)

    def _pass(self, seconds: float, controller: str | None) -> list[Tick]:
        ticks: list[Tick] = []
        for _ in range(_count(seconds, self.tick)):
            self._run.tick()
            for message in self._heard.taken():
                _hand_on(message, self.listener)
                if isinstance(message, Tick):
                    ticks.append(message)
            loop = self._run.loop
            _check(ticks[-1], controller, loop.supervisor.reason, loop.active.fallback)
        return ticks


class LiveRig:
    """The fish of a running fishd; while the rig is entered, it holds the lease of the fish.

    A few ticks that are lost on their way are missing in what it returns.
    """

    def __init__(self, fish: Fish, experiment: str = "experiment", take: bool = False) -> None:
        """
        experiment: what the lease is called, as `fishctl status` shows it
        take: take the fish from an experiment that has it

        Raises `NoDaemon`, `Refused` while another experiment holds the fish, and `ConfigError`
        where it swims freely.
        """
        status = fish.status()
        if status.lease and not take:
            raise Refused("leased", status.lease.refusal())
        check_tethered(status.robot, "a measurement of thrust")
        self.name = status.robot
        self.unit = status.force_unit
        simulated = status.robot == "simulated"
        self.calibration = EXACT if simulated else fish.calibrations().force
        self.tick = status.tick
        self.amplitude = status.amplitude_limit
        self.source: Source = "fishd"
        self.listener: Publisher | None = None
        self._fish = fish
        self._messages = fish.ticks_and_events()
        self._pid = status.pid
        self._latest = 0
        """Number of the latest tick that came."""
        self._lease = fish.lease(experiment, take=take, idle_limit=IDLE_LIMIT)
        self._held: LeaseRenewal

    def describe(self, writer: "RunWriter") -> None:
        """As `Rig.describe`; raises `NoDaemon`, too."""
        from fishd.recording.recorder import description

        description(self._fish).write(writer)

    def __enter__(self) -> Self:
        """Raises `Refused` while another experiment holds the fish."""
        self._held = self._lease.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        """Give the fish back, at rest; one that was taken by another request swims on."""
        self._lease.__exit__(*exception)

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """As `Rig.swim`; raises `NoDaemon` where fishd goes away."""
        with _disturbed():
            state = self._fish.set_controller(controller, **parameters)
            return self._pass(state.seq, seconds, controller)

    def rest(self, seconds: float) -> list[Tick]:
        """As `Rig.rest`; raises `NoDaemon` where fishd goes away."""
        with _disturbed():
            return self._pass(self._fish.stop().seq, seconds, None)

    def _pass(self, first: int, seconds: float, controller: str | None) -> list[Tick]:
        ticks: list[Tick] = []
        end = first + _count(seconds, self.tick)
        if first <= self._latest:
            raise _restarted()
        for tick in self._messages:
            _hand_on(tick, self.listener)
            if not isinstance(tick, Tick):
                if ticks and controller and tick.kind in ("parameters", "controller"):
                    self._fish.renew_lease(self._held.token)  # raises why it has ended
                    raise Disturbed(
                        f"another client changed what swims: {text.line(tick.message)}: this "
                        "measurement is lost"
                    )
                continue
            self._check_same_fishd(tick)
            if tick.seq < first:
                continue
            if not _as_told(tick, controller):
                status = self._fish.status()
                if not (status.reason or status.fallback):
                    self._fish.renew_lease(self._held.token)  # raises why it has ended
                _check(tick, controller, status.reason, status.fallback)
            if tick.seq < end:
                ticks.append(tick)
            if tick.seq >= end - 1:
                break
        if not ticks:
            refuse_lost(ticks, (seconds,), self.tick)
        return ticks

    def _check_same_fishd(self, tick: Tick) -> None:
        """Raise `Disturbed` where this tick is of another fishd than the first one."""
        before, self._latest = self._latest, tick.seq
        if tick.seq <= before:
            raise _restarted()
        # One that was restarted soon after its start may have got further meanwhile.
        if before and tick.seq > before + 1 and self._fish.status().pid != self._pid:
            raise _restarted()


@contextmanager
def _disturbed() -> Iterator[None]:
    """Turn the loss of the lease into `Disturbed`."""
    try:
        yield
    except LeaseLost as error:
        raise Disturbed(f"{text.said(error)}: this measurement is lost") from None


def _restarted() -> Disturbed:
    return Disturbed("fishd was restarted: this measurement is lost")


class _Heard:
    """Keeps ticks and events in their order until they are taken."""

    def __init__(self) -> None:
        self._messages: list[Tick | Event] = []

    def tick(self, tick: Tick) -> None:
        self._messages.append(tick)

    def event(self, event: Event) -> None:
        self._messages.append(event)

    def taken(self) -> list[Tick | Event]:
        """All of them, once."""
        messages, self._messages = self._messages, []
        return messages


def _hand_on(message: Tick | Event, listener: Publisher | None) -> None:
    if listener is None:
        return
    if isinstance(message, Tick):
        listener.tick(message)
    else:
        listener.event(message)


def _as_told(tick: Tick, controller: str | None) -> bool:
    if controller is None:
        return tick.mode == "idle"
    return (tick.mode, tick.controller) == ("running", controller)


def _check(
    tick: Tick, controller: str | None, reason: Reason | None, fallback: Reason | None
) -> None:
    """Raises `Disturbed` where the fish does another thing than it was told to.

    reason: why it is in mode fault or estop; fallback: why another controller took over
    """
    if _as_told(tick, controller):
        return
    told = f"told to let {controller} swim" if controller else "told to rest"
    cause = reason or fallback
    why = f" ({cause.message})" if cause else ""
    does = f"{tick.controller} swims" if tick.mode == "running" else f"it is in mode {tick.mode}"
    replaced = controller and fallback and tick.mode == "running"
    kind = Replaced if replaced else Disturbed
    raise kind(f"the fish was {told}, but {does}{why}: this measurement is lost")
