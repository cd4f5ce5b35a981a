"""Measures the candidates of a search on a rig: the fish swims with each, and rests in between."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from fishd.control.estimators.live_thrust import SWIM_SETTLE_TIME_S
from fishd.core.errors import ConfigError, ParameterError
from fishd.core.schema import Field
from fishd.core.signals import Tick
from fishd.lab.error_budget import visible_rotation
from fishd.lab.experiment import Experiment
from fishd.lab.measurement import REST, Step, evaluate, samples_of
from fishd.lab.optimise.least_power import LeastPower
from fishd.lab.optimise.search import Range, Search
from fishd.lab.session import Session, refuse_lost

STEADY = 1.5
"""How long the fish swims with each candidate once it has settled, at least [s]."""
BEATS = 2.0
"""How many beats of a candidate it swims then, at least: so one at least is whole."""
WAVE_SETTLES = 0.75
"""A given wave is steady after so long [s]: there is no estimator in it, and the fin follows."""
FREQUENCIES = 0.4
"""The lowest frequency that is searched unless another is asked for [Hz]."""
LONGEST = 200
"""The longest half beat that is searched where the frequencies begin at 0 [ticks]."""
FEWEST_VALUES = 3
"""A search of fewer frequencies is none: `compare` or `sweep` measures them all."""
SHORTEST = 2
"""The shortest half beat that is searched unless another is asked for [ticks]."""


class Trial(NamedTuple):
    """One candidate, as it was measured."""

    parameters: dict[str, float]
    """The searched ones."""
    thrust: float
    """[N]"""
    error: float
    """Half of its 95 % interval [N]."""
    power: float
    """Electrical power of the servo [W]; NaN where it is not known."""
    power_error: float
    """Half of its 95 % interval [W]."""
    swum: int
    """Ticks of swimming so far."""
    passed: float
    """Time since the beginning, rest included [s]."""
    rotation: float = 0.0
    """Rotation of the sensor as this swim shows it; 0 for one that was read from a table [rad]."""


COLUMNS = ("thrust", "error", "power", "power_error", "swum", "passed")
"""Columns of a table of trials, after those of the searched parameters."""


def read_trials(experiment: Experiment, names: Iterable[str]) -> list[Trial]:
    """Return the trials that a search has kept so far.

    names: of the searched parameters
    Raises `ConfigError` where the table is of something else.
    """
    names = tuple(names)
    trials = []
    for row in experiment.read_rows((*names, *COLUMNS)):
        try:
            values = {name: float(text) for name, text in row.items()}
        except ValueError as error:
            raise ConfigError(f"{experiment.path}: not a table of a search: {error}") from None
        parameters = {name: values.pop(name) for name in names}
        trials.append(Trial(parameters, **values)._replace(swum=int(values["swum"])))  # type: ignore[arg-type]
    return trials


def keep_trial(experiment: Experiment, trial: Trial) -> None:
    """Add a trial to the table of a search; raises `FishdError`."""
    experiment.add_row({**trial.parameters, **{name: getattr(trial, name) for name in COLUMNS}})


def trials(
    session: Session,
    controller: str,
    fixed: Mapping[str, Any],
    search: Search | LeastPower,
    budget: float,
    before: Trial | None = None,
    observe: Callable[[Trial], None] | None = None,
) -> Iterator[Trial]:
    """Measure candidates on a rig for as long as the budget lasts.

    The fish swims with a candidate, and rests; its thrust is what swimming adds to the force,
    beside a drift that is told apart by the rests before and after (`fishd.lab.measurement`).

    fixed: parameters that are not searched
    budget: time in the tank [s]
    before: the last one of a search that is resumed, which `search` knows already
    observe: told of each candidate, for `search` to know it; by default, its thrust
    Raises `ParameterError`, `Refused` and `Disturbed`.
    """
    rest: list[Tick] = []
    alike: list[Step] = []
    swum, passed = (before.swum, before.passed) if before else (0, 0.0)
    passed += REST
    while True:
        candidate = search.suggest()
        parameters = {**fixed, **candidate}
        settles, length = lengths(parameters)
        if passed + length + REST > budget:
            return
        if not rest:
            rest = session.rest(REST)
        swim = session.swim(controller, parameters, length)
        after = session.rest(REST)
        ticks = [*rest, *swim, *after]
        refuse_lost(ticks, (REST, length, REST), session.tick)
        found = evaluate(samples_of(ticks), session.tick, settles, alike=alike)
        alike += found.steps
        swum += len(swim)
        passed += length + REST
        power, power_error = (
            math.nan if each is None else each for each in (found.watts, found.watts_error)
        )
        rotation = visible_rotation(swim, settles)
        trial = Trial(
            candidate, found.thrust, found.error, power, power_error, swum, passed, rotation
        )
        if observe:
            observe(trial)
        else:
            assert isinstance(search, Search)
            search.observe(candidate, trial.thrust, trial.error)
        yield trial
        rest = after


def whole_ticks(frequencies: Range, tick: float) -> Range:
    """The same range, of the frequencies alone whose half beats are whole ticks.

    A few beats of one of those are like all others. Other half beats are dithered, over more beats
    than a candidate swims.

    tick: period of the loop [s]
    Raises `ParameterError` where there are fewer than `FEWEST_VALUES`.
    """
    name, low, high, _ = frequencies
    longest = math.floor(0.5 / low / tick + 1e-9) if low > 0.0 else LONGEST
    shortest = max(1, math.ceil(0.5 / high / tick - 1e-9))
    values = [0.5 / (ticks * tick) for ticks in range(longest, shortest - 1, -1)]
    if len(values) < FEWEST_VALUES:
        around = range(longest + 1, max(0, shortest - 2), -1)
        near = ", ".join(f"{0.5 / (ticks * tick):.4g}" for ticks in around)
        there = ", ".join(f"{value:.4g}" for value in values) or "none"
        raise ParameterError(
            f"{name}: too few values from {low:g} to {high:g}: only half beats of whole ticks are "
            f"compared, {FEWEST_VALUES} at least; there: {there}; around: {near}"
        )
    return Range(name, low, high, tuple(values))


def lengths(parameters: Mapping[str, Any]) -> tuple[float, float]:
    """After how long a candidate is steady, and how long it swims in all [s]."""
    frequency = parameters.get("frequency")
    if isinstance(frequency, int | float) and frequency > 0.0:
        return WAVE_SETTLES, WAVE_SETTLES + max(STEADY, BEATS / frequency)
    return SWIM_SETTLE_TIME_S, SWIM_SETTLE_TIME_S + STEADY


def default_range(field: Field, session: Session) -> Range | None:
    """What is searched of a parameter unless more is said; None where its bounds leave it open.

    A frequency from `FREQUENCIES` to half beats of `SHORTEST` ticks, an amplitude up to that of
    the rig; an end that is no value itself is moved in by a twentieth.
    """
    low, high = _ends(field)
    if field.name == "amplitude":
        return Range(field.name, session.amplitude / 20.0, session.amplitude)
    if math.isinf(low) or math.isinf(high):
        return None
    if field.name == "frequency":
        return Range(field.name, max(low, FREQUENCIES), min(high, 0.5 / (SHORTEST * session.tick)))
    margin = (high - low) / 20.0
    return Range(
        field.name,
        low + margin * field.interval.startswith("("),
        high - margin * field.interval.endswith(")"),
    )


def check_bounds(asked: Range, field: Field, session: Session) -> None:
    """Raises `ParameterError` where a parameter cannot be searched between these."""
    low, high = _ends(field)
    if field.name == "amplitude":
        high = min(high, session.amplitude)
    is_open = field.interval.startswith("(") and asked.low == low
    is_open |= field.interval.endswith(")") and asked.high == high
    if asked.low < low or asked.high > high or is_open:
        reach = f"{field.interval[:1] or '['}{low:g}, {high:g}{field.interval[-1:] or ']'}"
        raise ParameterError(
            f"{asked.name}: from {asked.low:g} to {asked.high:g} is not within {reach}"
        )


def _ends(field: Field) -> tuple[float, float]:
    """Between what its values are; infinite where nothing bounds them."""
    parts = field.interval.strip("()[]").split(", ")
    if len(parts) != 2:
        return -math.inf, math.inf
    return float(parts[0]), float(parts[1])
