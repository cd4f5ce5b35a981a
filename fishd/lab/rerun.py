"""Rerun of the estimator and a controller on a recording, compared with the original run.

The controller sees the forces of each tick and the angles that were truly applied, so each of its
commands answers the recorded past, not its own. From a start of a controller that is in the
recording, the rerun gives the same bits as the original. The past of a controller that started
earlier, or before ticks that are missing, is unknown.
"""

from collections.abc import Callable, Iterable, Mapping
from itertools import islice
from typing import Any, TypeVar

from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from fishd.assembly import build_estimator, build_guard
from fishd.config import Config, adopt
from fishd.controllers import registry
from fishd.controllers.base import Controller
from fishd.core import text
from fishd.core.errors import FishdError, RecordingError
from fishd.core.foreign_code import call_foreign
from fishd.core.signals import Event, Measurement, Observation, Status, Tick
from fishd.recording.reader import Run
from fishd.recording.summary import Tally

T = TypeVar("T")
Messages = Iterable[Event | Status | Tick]
ESTIMATES = ("fy_rate", "fin_velocity", "frequency")
"""Estimates that ticks contain; their thrust is that of the live filter, not the estimator's."""


class Stretch(Struct):
    """Ticks without a gap in which one controller swam, and their comparison with the rerun."""

    recorded: str
    """Name of the controller that swam."""
    parameters: dict[str, Any]
    """Parameters of the recorded controller at the start of the stretch."""
    controller: str
    """Name of the controller of the rerun."""
    t: float
    """Time of the first compared tick [s, unix]."""
    seq: int
    """Number of the first compared tick."""
    from_start: bool
    """True where the recording contains the start of the controller, so that its past is known."""
    ticks: int = 0
    """Number of compared ticks."""
    equal: int = 0
    """Number of ticks in which the angle is the same to the last bit."""
    largest: float = 0.0
    """Largest difference of the angle [rad]."""
    differs_last: int | None = None
    """Number of the last tick in which the angle differs."""


class Estimates(Struct):
    """Comparison of the estimates of the rerun with the recorded ones."""

    from_start: bool = True
    """True where the recording starts with fishd and has no gap, so that the past is known."""
    ticks: int = 0
    equal: int = 0
    """Number of ticks in which all estimates are the same to the last bit."""


class Rerun(Struct):
    """Result of a rerun: stretches in order, and the comparison of the estimates."""

    stretches: list[Stretch]
    estimates: Estimates


def rerun(
    run: Run,
    name: str | None = None,
    parameters: Mapping[str, Any] | None = None,
    overrides: Iterable[str] = (),
) -> Rerun:
    """Rerun a controller in every tick of a recording in which a controller swam.

    name: name of the controller; None for the recorded one of each stretch
    parameters: its parameters; the others are the recorded ones for the recorded controller, and
        the defaults for another one
    overrides: KEY=VALUE of the configuration. Where they change the estimator, the controller
        sees the new estimates; else the recorded ones, which are exact from the first tick on.

    Raises `RecordingError`, and the errors of the controller for its parameters.
    """
    if "remote" in (name, *run.summary.swim_ticks):
        raise RecordingError(
            f"{run.path}: 'remote' has no rerun: its commands came from another program"
        )
    comparison = _Rerun(run, name, dict(parameters or {}), tuple(overrides))
    messages = list(run.messages())
    tally = Tally()
    for index, message in enumerate(messages):
        tally.add(message, run.times[index])
        if isinstance(message, Event):
            comparison.event(message)
        elif isinstance(message, Tick):
            comparison.tick(message, tally.restarts, islice(messages, index, None))
    return Rerun(comparison.stretches, comparison.estimates)


class _Rerun:
    def __init__(
        self, run: Run, name: str | None, parameters: dict[str, Any], overrides: tuple[str, ...]
    ) -> None:
        self._run, self._name, self._parameters = run, name, parameters
        self._overrides = overrides
        self.stretches: list[Stretch] = []
        self.estimates = Estimates()
        self._number = -1
        """Number of the fishd whose ticks are compared."""
        self._last: Tick | None = None
        self._trusted = Measurement(0.0, 0.0, 0.0, 0)
        """Last trusted measurement, as the control loop keeps it."""
        self._before = 0.0
        """Angle before that of the last tick [rad]."""
        self._started: tuple[str, dict[str, Any]] | None = None
        """Controller that starts in the next tick, and its parameters."""
        self._retunes: list[dict[str, Any]] = []
        """Changes of its parameters before that tick."""
        self._swims: Controller[Any] | None = None

    def event(self, event: Event) -> None:
        """Store a change that applies from the next tick on."""
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
        """Return a field of the data of an event; raises `RecordingError` where it is missing."""
        value = event.data.get(name)
        if not isinstance(value, kind):
            raise RecordingError(
                f"{self._run.path}: an event '{text.quoted(event.kind)}' has no {name}"
            )
        return value

    def tick(self, tick: Tick, number: int, upcoming: Messages) -> None:
        """Rerun one tick; number: number of its fishd in the recording."""
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
        dt = (1 + tick.missed_slots - (last.missed_slots if last else 0)) * self._config.tick
        if not whole:  # time and angle of the tick before are unknown
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
        self._trusted = Measurement(0.0, 0.0, 0.0, 0)
        recorded = self._run.config_of(self._number)
        self._config: Config = adopt(self._run.settings_of(self._number), self._overrides)
        uses_plant = self._config.estimator.kind == "observer"
        self._estimates_again = self._config.estimator != recorded.estimator or (
            uses_plant and self._config.plant != recorded.plant
        )
        self._estimator = build_estimator(self._config)
        self.estimates.from_start &= tick.seq == 1
        self._guard = build_guard(self._config)
        description = next(
            (daemon for daemon in self._run.daemons if daemon.get("number") == str(self._number)),
            {},
        )
        if "lowest_angle" in description:
            try:
                self._guard.restrict(
                    float(description["lowest_angle"]), float(description["highest_angle"])
                )
            except (KeyError, ValueError):
                raise RecordingError(
                    f"{self._run.path}: the angle limits of fishd {self._number} are not numbers"
                ) from None

    def _observe(self, tick: Tick, applied: float, dt: float) -> Observation:
        """Return the observation of the controller in this tick."""
        measurement = Measurement(
            tick.time - 1e-3 * tick.sample_age_ms,
            tick.fx,
            tick.fy,
            tick.samples,
            fin_velocity=tick.fin_velocity,
        )
        if tick.suspect is UNSET:
            self._trusted = replace(measurement, samples=0)
        else:
            measurement = self._trusted
        corrected = tick.fy_corrected is True
        if corrected is not self._estimator.fy_corrected:
            self._estimator.reverse_fy()
        estimated = self._estimator.update(measurement, applied, tick.time, dt)
        recorded = {name: getattr(tick, name) for name in ESTIMATES}
        if corrected:
            recorded["fy_rate"] = -tick.fy_rate
        self.estimates.ticks += 1
        self.estimates.equal += all(
            getattr(estimated, name) == value for name, value in recorded.items()
        )
        if self._estimates_again:
            return estimated
        return replace(
            estimated,
            previous_angle=self._before,
            thrust_factor=_none_if_unset(tick.thrust_factor),
            thrust_factor_ci95=_none_if_unset(tick.thrust_factor_ci95),
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
            # fishd starts a configured controller in tick 1, before a recorder receives events.
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
        """Call a method of the controller; raises `RecordingError` where it fails."""
        try:
            return call_foreign(method, seen)
        except Exception as error:
            raise RecordingError(
                f"{self._run.path}: in tick {tick.seq}, {self.stretches[-1].controller} failed: "
                f"{text.describe_error(error)}"
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
        """Apply a recorded change of parameters where the recorded controller runs again."""
        stretch, swims = self.stretches[-1], self._swims
        if swims is not None and stretch.controller == stretch.recorded:
            values = {**parameters, **self._parameters}
            try:
                checked = registry.check(stretch.controller, values, swims.limits)
            except FishdError as error:
                raise RecordingError(f"{self._run.path}: {error}") from None
            call_foreign(swims.retune, checked)

    def _parameters_of(self, tick: Tick, upcoming: Messages) -> dict[str, Any]:
        """Return the parameters of a controller without a recorded start, from the next status."""
        for message in upcoming:
            if isinstance(message, Status) and message.controller == tick.controller:
                return message.parameters
            if isinstance(message, Event) and message.kind in ("controller", "fallback"):
                break
        start = self._config.start
        return dict(start.parameters) if start.controller == tick.controller else {}


def _none_if_unset(value: float | UnsetType) -> float | None:
    return None if value is UNSET else value
