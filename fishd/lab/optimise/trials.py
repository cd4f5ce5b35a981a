"""Measurement of a search's candidates on a rig, and the aim that they are judged by.

The fish swims with each candidate, and rests between.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from msgspec.structs import replace

from fishd.core.errors import ConfigError, ParameterError
from fishd.core.estimation import SWIM_SETTLE_TIME_S
from fishd.core.schema import Field, format_permitted, is_valid_number
from fishd.core.signals import Tick
from fishd.core.swim_plan import MEAN_REST_S, MEAN_SWIM_S
from fishd.lab.error_budget import visible_rotation
from fishd.lab.experiment import Experiment
from fishd.lab.measurement import Step, evaluate, to_samples
from fishd.lab.optimise.least_power import LeastPower
from fishd.lab.optimise.search import Range, Search
from fishd.lab.session import Session, refuse_lost
from fishd.lab.statistics import per_watt

MIN_STEADY_S = 3.0
"""Shortest measured time of each candidate, after it has settled [s]."""
MIN_BEATS, SETTLE_BEATS = 3.0, 1.0
"""Smallest number of measured beats of each candidate, and of beats before them."""
UNKNOWN_BEAT_S = 1.0
"""Beat of a controller that chooses it, before one was measured [s]."""
FINAL_SWIMS = 2
"""Number of swims of the best candidate at the end, each of `MEAN_SWIM_S`."""
WAVE_SETTLE_S = 0.75
"""Time until a wave of fixed frequency is steady [s]; no estimator has to converge."""
MIN_FREQUENCY_HZ = 0.4
"""Default lower end of the range of a frequency [Hz]."""
MAX_HALF_BEAT_TICKS = 200
"""Longest half beat of a search whose frequencies begin at 0 [ticks]."""
MIN_VALUES = 3
"""Smallest number of frequencies of a search; fewer can all be measured by `compare`."""
MIN_HALF_BEAT_TICKS = 2
"""Default shortest half beat of a search [ticks]."""


class Candidate(NamedTuple):
    """Parameters to measure."""

    parameters: dict[str, float]
    """Searched parameters."""
    is_final: bool = False
    """Whether they are the best known ones, whose measurement is the result."""

    def durations(self, fixed: Mapping[str, Any], beat: float) -> tuple[float, float, int]:
        """Return the time until it is steady [s], the length of a swim [s], and their number.

        fixed: parameters that are not searched; beat: as for `trial_durations`
        """
        settles, length = trial_durations({**fixed, **self.parameters}, beat)
        if self.is_final:
            return settles, max(length, settles + MEAN_SWIM_S), FINAL_SWIMS
        return settles, length, 1


class Trial(NamedTuple):
    """Measured candidate."""

    parameters: dict[str, float]
    """Searched parameters."""
    thrust: float
    """Measured thrust [N]."""
    thrust_ci95: float
    """Half-width of the 95 % confidence interval of `thrust` [N]."""
    power: float
    """Electrical power of the servo [W]; NaN if unknown."""
    power_ci95: float
    """Half-width of the 95 % confidence interval of `power` [W]."""
    swim_ticks: int
    """Ticks of swimming from the beginning of the search."""
    tank_time: float
    """Tank time from the beginning of the search, rests included [s]."""
    beat: float = 0.0
    """Period of its beat [s]; 0 without beats."""
    is_final: float = 0.0
    """1 for a measurement of the best candidate that is longer and may be the result, else 0."""
    rotation: float = 0.0
    """Rotation of the sensor visible in this swim [rad]."""


TRIAL_COLUMNS = (
    *("thrust", "thrust_ci95", "power", "power_ci95"),
    *("swim_ticks", "tank_time", "beat", "is_final"),
)
"""Columns of a table of trials, after the columns of the searched parameters."""


class TrialTable:
    """Table of the trials of a search, in the folder of its experiment."""

    def __init__(self, experiment: Experiment, names: Iterable[str]) -> None:
        """Read the candidates of an interrupted search.

        names: names of the searched parameters
        Raises `ConfigError` if the table is not that of such a search, and `FishdError`.
        """
        names = tuple(names)
        self._table = experiment.open_table((*names, *TRIAL_COLUMNS))
        try:
            self.candidates = [
                Candidate({name: float(row[name]) for name in names}, bool(float(row["is_final"])))
                for row in self._table.rows
            ]
        except ValueError as error:
            raise ConfigError(f"{experiment.path}: not a table of a search: {error}") from None

    def add(self, trial: Trial) -> None:
        """Add a trial; raises `FishdError`."""
        self._table.add(
            {**trial.parameters, **{name: getattr(trial, name) for name in TRIAL_COLUMNS}}
        )


def measure_trials(
    session: Session,
    controller: str,
    fixed: Mapping[str, Any],
    choose: Callable[[float], Candidate | None],
    budget: float,
    before: Sequence[Candidate] = (),
) -> Iterator[Trial]:
    """Measure candidates on a rig until there is none, or for as long as the budget lasts.

    The fish swims with a candidate, then rests. The thrust is the force while swimming minus the
    drift, which the rests before and after determine (`fishd.lab.measurement`).

    fixed: parameters that are not searched
    choose: returns the next candidate for the time left [s]; the one before was yielded
    budget: time in the tank [s]
    before: candidates of an interrupted search, which come first whatever is chosen and left; its
        session has their swims in its log, or swims them again in virtual time
    Raises `ParameterError`, `Refused` and `Disturbed`.
    """
    kept = list(before)
    rest: list[Tick] = []
    steps: list[Step] = []
    swim_ticks, tank_time, beat = 0, MEAN_REST_S, 0.0
    while True:
        candidate = choose(budget - tank_time)
        is_kept = bool(kept)
        if is_kept:
            candidate = kept.pop(0)
        if candidate is None:
            return
        parameters = {**fixed, **candidate.parameters}
        settles, length, swims = candidate.durations(fixed, beat)
        duration = swims * (length + MEAN_REST_S)
        if tank_time + duration > budget and not is_kept:
            return
        rest = rest or session.rest(MEAN_REST_S)
        ticks, swum = [*rest], 0
        for _ in range(swims):
            swim = session.swim(controller, parameters, length)
            rest = session.rest(MEAN_REST_S)
            ticks += [*swim, *rest]
            swum += len(swim)
        refuse_lost(ticks, (MEAN_REST_S, *(length, MEAN_REST_S) * swims), session.tick)
        evaluation = evaluate(to_samples(ticks), session.tick, settles, other_steps=steps)
        steps += evaluation.steps
        swim_ticks += swum
        tank_time += duration
        beat = 1.0 / evaluation.frequency if evaluation.frequency else 0.0
        power, power_ci95 = (
            math.nan if value is None else value
            for value in (evaluation.power, evaluation.power_ci95)
        )
        yield Trial(
            candidate.parameters,
            evaluation.thrust,
            evaluation.thrust_ci95,
            power,
            power_ci95,
            swim_ticks,
            tank_time,
            beat,
            float(candidate.is_final),
            visible_rotation(swim, settles),
        )


def restrict_to_whole_ticks(frequencies: Range, tick: float) -> Range:
    """Return the range with only those frequencies whose half beats are whole ticks.

    All beats of such a frequency are alike. Other half beats are dithered, over more beats than
    a candidate swims.

    tick: period of the loop [s]
    Raises `ParameterError` if there are fewer than `MIN_VALUES`.
    """
    name, low, high, _ = frequencies
    longest = math.floor(0.5 / low / tick + 1e-9) if low > 0.0 else MAX_HALF_BEAT_TICKS
    shortest = max(1, math.ceil(0.5 / high / tick - 1e-9))
    values = [0.5 / (ticks * tick) for ticks in range(longest, shortest - 1, -1)]
    if len(values) < MIN_VALUES:
        half_beats = range(longest + 1, max(0, shortest - 2), -1)
        near = ", ".join(f"{0.5 / (ticks * tick):.4g}" for ticks in half_beats)
        listed = ", ".join(f"{value:.4g}" for value in values) or "none"
        raise ParameterError(
            f"{name}: too few values from {low:g} to {high:g}: only half beats of whole ticks are "
            f"compared, {MIN_VALUES} at least; in this range: {listed}; near it: {near}"
        )
    return Range(name, low, high, tuple(values))


def trial_durations(parameters: Mapping[str, Any], beat: float = 0.0) -> tuple[float, float]:
    """Return the time until a candidate is steady, and the whole time of its swim [s].

    A swim contains `MIN_BEATS` whole beats after as many beats as a fin needs to be steady.
    beat: beat of the trial before [s], for controllers that choose their own; 0 if unknown
    """
    frequency = parameters.get("frequency")
    if isinstance(frequency, int | float) and frequency > 0.0:
        beat, settles = 1.0 / frequency, WAVE_SETTLE_S
    else:
        beat, settles = beat or UNKNOWN_BEAT_S, SWIM_SETTLE_TIME_S
    settles = max(settles, SETTLE_BEATS * beat)
    return settles, settles + max(MIN_STEADY_S, MIN_BEATS * beat)


def make_range(field: Field, low: float | None, high: float | None, session: Session) -> Range:
    """Return the range of a searched parameter; None for an end stands for its default.

    The frequencies of a range have half beats of whole ticks.
    Raise `ParameterError` for a range that the parameter does not permit, and for an end without
    a default.
    """
    default_low, default_high = _default_ends(field, session)
    low, high = default_low if low is None else low, default_high if high is None else high
    if math.isinf(low) or math.isinf(high):
        which = "lower" if math.isinf(low) else "upper"
        raise ParameterError(f"{field.name}: it has no {which} bound: give it LOW:HIGH")
    searched = Range(field.name, low, high)
    searched.check()
    _check_bounds(searched, field, session)
    return (
        restrict_to_whole_ticks(searched, session.tick) if field.name == "frequency" else searched
    )


def _default_ends(field: Field, session: Session) -> tuple[float, float]:
    """Return the default ends of the range of a parameter; infinite without a bound.

    A frequency is searched from `MIN_FREQUENCY_HZ` to half beats of `MIN_HALF_BEAT_TICKS`, an
    amplitude up to that of the rig. An excluded end is moved inwards by a twentieth of the range.
    """
    low, high = _bounds(field)
    if field.name == "amplitude":
        return session.amplitude / 20.0, session.amplitude
    if field.unit == "rad":
        return max(low, -session.amplitude), min(high, session.amplitude)
    if field.name == "frequency":
        return max(low, MIN_FREQUENCY_HZ), min(high, 0.5 / (MIN_HALF_BEAT_TICKS * session.tick))
    margin = (high - low) / 20.0
    if math.isinf(margin):
        return low, high
    return low + margin * field.low_open, high - margin * field.high_open


def _check_bounds(searched: Range, field: Field, session: Session) -> None:
    """Raise `ParameterError` if a range exceeds the bounds of its parameter."""
    low, high = _bounds(field)
    if field.unit == "rad":
        low, high = max(low, -session.amplitude), min(high, session.amplitude)
    field = replace(field, low=low, high=high)
    values = {"low": searched.low, "high": searched.high}
    if not all(is_valid_number(values, replace(field, name=end)) for end in values):
        raise ParameterError(
            f"{searched.name}: from {searched.low:g} to {searched.high:g} is not within "
            f"{format_permitted(field)}"
        )


def _bounds(field: Field) -> tuple[float, float]:
    """Return the bounds of a parameter; infinite if it has none."""
    return (
        -math.inf if field.low is None else field.low,
        math.inf if field.high is None else field.high,
    )


class Aim(NamedTuple):
    """Objective or target of a search."""

    objective: Literal["thrust", "thrust-per-watt"] = "thrust"
    """Quantity to maximise; ignored if there is a target."""
    target: float | None = None
    """Thrust to reach at the least power [N]."""

    def make_search(self, ranges: Sequence[Range], seed: int) -> Search | LeastPower:
        """Return a new search with this aim; raises `ParameterError`."""
        if self.target is not None:
            return LeastPower(ranges, self.target, seed)
        return Search(ranges, seed)

    def observe(self, search: Search | LeastPower, trial: Trial) -> None:
        """Add a measured candidate to a search, with the quantity of this aim.

        Raises `ParameterError` if the aim needs the power, and the power is unknown.
        """
        thrust = trial.thrust, trial.thrust_ci95
        if self.objective == "thrust" and self.target is None:
            assert isinstance(search, Search)
            search.observe(trial.parameters, *thrust)
            return
        if not (math.isfinite(trial.power) and trial.power > 0.0):
            raise ParameterError(
                "this needs the power of the servo, and the fish has no power meter that can be "
                "read: add one to sensors in its configuration, see docs/how-to/bench.md"
            )
        if isinstance(search, LeastPower):
            search.observe(trial.parameters, thrust, (trial.power, trial.power_ci95))
            return
        value, error = per_watt(*thrust, trial.power, trial.power_ci95)
        assert value is not None
        assert error is not None
        search.observe(trial.parameters, value, error)
