"""Lets the estimator and a controller decide again, on what was recorded, and compares.

The controller sees what it would have seen: the forces of each tick, and the angles that were
truly applied. So each of its commands answers the recorded past, not its own. It gives the very
same bits from every start of a controller that is in the recording; one that had begun before,
or before ticks that are missing, has a past that nobody knows.
"""

from collections.abc import Callable, Iterable, Mapping
from itertools import islice
from typing import Any, TypeVar

from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from fishd.assembly import build_estimator
from fishd.config import Config, adopt
from fishd.control.guard import Guard
from fishd.controllers import registry
from fishd.controllers.base import Controller
from fishd.core import text
from fishd.core.errors import FishdError, RecordingError
from fishd.core.foreign_code import contained
from fishd.core.signals import Event, Measurement, Observation, Status, Tick
from fishd.recording.reader import Run
from fishd.recording.summary import Tally

T = TypeVar("T")
Messages = Iterable[Event | Status | Tick]
ESTIMATES = ("fy_rate", "fin_velocity", "frequency")
"""What the estimator adds to a measurement, and ticks tell; their thrust is that of the filter."""


class Stretch(Struct):
    """Ticks without a gap in which one controller swam, and how those of the rerun compare."""

    recorded: str
    """The controller that swam."""
    parameters: dict[str, Any]
    """Those at its start."""
    controller: str
    """The one that chose again."""
    t: float
    """Time of the first tick that is compared [s, unix]."""
    seq: int
    """Its number."""
    from_start: bool
    """Is the start of the controller in the recording? Only then is all its past known."""
    ticks: int = 0
    equal: int = 0
    """Ticks in which the angle is the same to the last bit."""
    largest: float = 0.0
    """The largest difference of the angle [rad]."""
    differs_last: int | None = None
    """Number of the last tick in which it differs."""


class Estimates(Struct):
    """How what the estimator says again compares with what it said."""

    from_start: bool = True
    """Did the recording begin with fishd, without a gap? Only then is all its past known."""
    ticks: int = 0
    equal: int = 0
    """Ticks in which all are the same to the last bit."""


class Rerun(Struct):
    """The result: one stretch after the other."""

    stretches: list[Stretch]
    estimates: Estimates


def rerun(
    run: Run,
    name: str | None = None,
    parameters: Mapping[str, Any] | None = None,
    overrides: Iterable[str] = (),
) -> Rerun:
    """Let a controller choose again in every tick in which one swam.

    name: of the controller; None for the one that swam, whichever it was
    parameters: of it; the others are those that were recorded where it is the one that swam, and
        else their defaults
    overrides: KEY=VALUE of the configuration. Where the estimator is another one by them, the
        controller sees its new estimates; else those that were recorded, which are exact from the
        first tick on.

    Raises `RecordingError`, and what the controller raises for its parameters.
    """
    if "remote" in (name, *run.summary.swimming):
        raise RecordingError(
            f"{run.path}: remote asks a program for its commands, which cannot be asked again"
        )
    again = _Rerun(run, name, dict(parameters or {}), tuple(overrides))
    messages = list(run.messages())
    tally = Tally()
    for index, message in enumerate(messages):
        tally.add(message)
        if isinstance(message, Event):
            again.event(message)
        elif isinstance(message, Tick):
            again.tick(message, tally.restarts, islice(messages, index, None))
    return Rerun(again.stretches, again.estimates)


class _Rerun:
    def __init__(
        self, run: Run, name: str | None, parameters: dict[str, Any], overrides: tuple[str, ...]
    ) -> None:
        self._run, self._name, self._parameters = run, name, parameters
        self._overrides = overrides
        self.stretches: list[Stretch] = []
        self.estimates = Estimates()
        self._number = -1
        """Of the fishd whose ticks are compared."""
        self._last: Tick | None = None
        self._believed = Measurement(0.0, 0.0, 0.0, 0)
        """As of the loop."""
        self._before = 0.0
        """The angle before that of the last tick [rad]."""
        self._started: tuple[str, dict[str, Any]] | None = None
        """A controller that takes over in the next tick, and its parameters."""
        self._retunes: list[dict[str, Any]] = []
        """Changes of its parameters that came before that tick."""
        self._swims: Controller[Any] | None = None

    def event(self, event: Event) -> None:
        """Take note of what changes from the next tick on."""
        if event.kind in ("controller", "fallback"):
            self._started = (
                self._read_data(event, "controller", str),
                self._read_data(event, "parameters", dict),
            )
            self._retunes = []
        elif event.kind == "parameters":
            if self._started is not None:
                self._retunes.append(self._read_data(event, "parameters", dict))
            elif self._swims is not None:
                self._retune(self._read_data(event, "parameters", dict))
        elif event.kind in ("mode", "fault") and event.data.get("mode") != "running":
            self._swims = None
            if self._last is not None:
                self._estimator.rest()
        elif (
            event.kind == "calibration"
            and event.message.startswith("force sensor: ")
            and self._last is not None
        ):
            self._estimator.forget_zero()

    def _read_data(self, event: Event, name: str, kind: type[T]) -> T:
        """What the data of an event say; raises `RecordingError` where they do not."""
        value = event.data.get(name)
        if not isinstance(value, kind):
            raise RecordingError(
                f"{self._run.path}: an event '{text.quoted(event.kind)}' does not say its {name}"
            )
        return value

    def tick(self, tick: Tick, number: int, upcoming: Messages) -> None:
        """Choose again in one tick; number: of its fishd, as the recorder has counted."""
        last = self._last
        if number != self._number:
            self._begin_fishd(tick, number)
            last = None
        elif last is not None and tick.seq > last.seq + 1:
            self.estimates.from_start = False
            self._swims = None
            last = None
        whole = last is not None or tick.seq == 1
        applied = last.phi_c if last else 0.0
        dt = (1 + tick.missed - (last.missed if last else 0)) * self._config.tick
        if not whole:  # how long ago the tick before was, and its angle, are not known
            applied, dt = tick.phi_c, self._config.tick
        seen = self._observe(tick, applied, dt)
        if tick.mode != "running":
            self._swims = None
        elif whole:
            self._compare(tick, seen, applied, upcoming)
        self._last, self._before = tick, applied

    def _begin_fishd(self, tick: Tick, number: int) -> None:
        self._number = number
        self._swims = None
        self._before = 0.0
        self._believed = Measurement(0.0, 0.0, 0.0, 0)
        recorded = self._run.config_of(self._number)
        self._config: Config = adopt(self._run.settings_of(self._number), self._overrides)
        modelled = self._config.estimator.kind == "observer"
        self._estimates_again = self._config.estimator != recorded.estimator or (
            modelled and self._config.plant != recorded.plant
        )
        self._estimator = build_estimator(self._config)
        self.estimates.from_start &= tick.seq == 1
        config = self._config
        self._guard = Guard(
            config.amplitude_limit, config.tick, config.slew_limit, config.fade_time
        )
        about = next(
            (each for each in self._run.daemons if each.get("number") == str(self._number)), {}
        )
        if "lowest" in about:
            try:
                self._guard.restrict(float(about["lowest"]), float(about["highest"]))
            except (KeyError, ValueError):
                raise RecordingError(
                    f"{self._run.path}: the angles that fishd {self._number} permits are not "
                    "numbers"
                ) from None

    def _observe(self, tick: Tick, applied: float, dt: float) -> Observation:
        """What the controller sees in this tick."""
        measurement = Measurement(
            tick.t - 1e-3 * tick.age_ms,
            tick.fx,
            tick.fy,
            tick.samples,
            fin_velocity=tick.fin_velocity,
        )
        if tick.suspect is UNSET:
            self._believed = replace(measurement, samples=0)
        else:
            measurement = self._believed
        corrected = tick.fy_corrected is True
        if corrected is not self._estimator.fy_corrected:
            self._estimator.reverse_fy()
        again = self._estimator.update(measurement, applied, tick.t, dt)
        recorded = {name: getattr(tick, name) for name in ESTIMATES}
        if corrected:
            recorded["fy_rate"] = -tick.fy_rate
        self.estimates.ticks += 1
        self.estimates.equal += all(
            getattr(again, name) == value for name, value in recorded.items()
        )
        if self._estimates_again:
            return again
        return replace(
            again,
            previous_angle=self._before,
            thrust_factor=_known(tick.thrust_factor),
            thrust_factor_error=_known(tick.thrust_factor_error),
            **recorded,
        )

    def _compare(
        self,
        tick: Tick,
        seen: Observation,
        applied: float,
        upcoming: Messages,
    ) -> None:
        started, self._started = self._started, None
        if started is not None or self._swims is None:
            known = started is not None and started[0] == tick.controller
            if not known:
                started = tick.controller, self._parameters_of(tick, upcoming)
            assert started
            # At its first tick fishd begins as it is configured to; nobody hears it say so.
            self._begin(tick, *started, from_start=known or tick.seq == 1)
            for values in self._retunes:
                self._retune(values)
            self._retunes = []
            assert self._swims
            self._call(tick, self._swims.activate, seen)
        assert self._swims
        stretch = self.stretches[-1]
        update = self._swims.update
        angle = self._call(tick, lambda seen: self._guard.apply(update(seen), applied), seen)
        stretch.ticks += 1
        if angle == tick.phi_c:
            stretch.equal += 1
        else:
            stretch.largest = max(stretch.largest, abs(angle - tick.phi_c))
            stretch.differs_last = tick.seq

    def _call(self, tick: Tick, method: Callable[[Observation], T], seen: Observation) -> T:
        """Call a method of the controller; raises `RecordingError` where that fails."""
        try:
            return contained(method, seen)
        except Exception as error:
            raise RecordingError(
                f"{self._run.path}: in tick {tick.seq}, {self.stretches[-1].controller} failed: "
                f"{text.named(error)}"
            ) from error

    def _begin(
        self, tick: Tick, recorded: str, parameters: dict[str, Any], *, from_start: bool
    ) -> None:
        name = self._name or recorded
        given = {**parameters, **self._parameters} if name == recorded else self._parameters
        limits = replace(self._config.limits, virtual=self._run.about.get("source") == "simulation")
        try:
            self._swims = registry.create(name, given, limits)
        except FishdError as error:
            if self._name or self._parameters:
                raise
            raise RecordingError(f"{self._run.path}: {error}") from None
        self.stretches.append(
            Stretch(recorded, parameters, name, tick.t, tick.seq, from_start=from_start)
        )

    def _retune(self, parameters: dict[str, Any]) -> None:
        """Change parameters as was recorded; another controller than the recorded one keeps its."""
        stretch, swims = self.stretches[-1], self._swims
        if swims is not None and stretch.controller == stretch.recorded:
            values = {**parameters, **self._parameters}
            try:
                checked = registry.check(stretch.controller, values, swims.limits)
            except FishdError as error:
                raise RecordingError(f"{self._run.path}: {error}") from None
            contained(swims.retune, checked)

    def _parameters_of(self, tick: Tick, upcoming: Messages) -> dict[str, Any]:
        """Those of a controller whose start is not in the recording: as the next status says."""
        for message in upcoming:
            if isinstance(message, Status) and message.controller == tick.controller:
                return message.parameters
            if isinstance(message, Event) and message.kind in ("controller", "fallback"):
                break
        start = self._config.start
        return dict(start.parameters) if start.controller == tick.controller else {}


def _known(value: float | UnsetType) -> float | None:
    return None if value is UNSET else value
