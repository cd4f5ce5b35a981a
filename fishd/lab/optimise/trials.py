"""Measures the candidates of a search on a rig: the fish swims with each, and rests in between."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from fishd.control.estimators.live_thrust import SWIM_SETTLES
from fishd.core.schema import Field
from fishd.lab.measurement import REST, evaluate, samples_of
from fishd.lab.optimise.search import Range, Search
from fishd.lab.rig import Rig, refuse_lost

STEADY = 1.5
"""How long the fish swims with each candidate once it has settled, at least [s]."""
BEATS = 2.0
"""How many beats of a candidate it swims then, at least: so one at least is whole."""
WAVE_SETTLES = 0.75
"""A given wave is steady after so long [s]: there is no estimator in it, and the fin follows."""
FREQUENCIES = 0.4
"""The lowest frequency that is searched unless another is asked for [Hz]."""
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
    swum: int
    """Ticks of swimming so far."""
    passed: float
    """Time since the beginning, rest included [s]."""


def trials(
    rig: Rig, controller: str, fixed: Mapping[str, Any], search: Search, budget: float
) -> Iterator[Trial]:
    """Measure candidates on a rig for as long as the budget lasts; `search` knows of each.

    The fish swims with a candidate, and rests; its thrust is what swimming adds to the force,
    beside a drift that is told apart by the rests before and after (`fishd.lab.measurement`).

    fixed: parameters that are not searched
    budget: time in the tank [s]
    Raises `ParameterError`, `Refused` and `Disturbed`.
    """
    rest = rig.rest(REST)
    swum, passed = 0, REST
    while True:
        candidate = whole_ticks(search.suggest(), search.ranges, rig.tick)
        parameters = {**fixed, **candidate}
        settles, length = lengths(parameters)
        if passed + length + REST > budget:
            return
        swim = rig.swim(controller, parameters, length)
        after = rig.rest(REST)
        ticks = [*rest, *swim, *after]
        refuse_lost(ticks, (REST, length, REST), rig.tick)
        found = evaluate(samples_of(ticks), rig.tick, settles)
        swum += len(swim)
        passed += length + REST
        search.observe(candidate, found.thrust, found.error)
        yield Trial(candidate, found.thrust, found.error, swum, passed)
        rest = after


def whole_ticks(
    candidate: dict[str, float], ranges: Sequence[Range], tick: float
) -> dict[str, float]:
    """The nearest candidate in these ranges whose half beats are whole ticks, if there is one.

    A few beats of that are like all others. Other half beats are dithered, over more beats than a
    candidate swims.
    """
    found = [each for each in ranges if each.name == "frequency" and each.low > 0.0]
    if not found:
        return candidate
    fewest = max(1, math.ceil(0.5 / found[0].high / tick - 1e-9))
    most = math.floor(0.5 / found[0].low / tick + 1e-9)
    if most < fewest:
        return candidate
    ticks = min(most, max(fewest, round(0.5 / candidate["frequency"] / tick)))
    return candidate | {"frequency": 0.5 / (ticks * tick)}


def lengths(parameters: Mapping[str, Any]) -> tuple[float, float]:
    """After how long a candidate is steady, and how long it swims in all [s]."""
    frequency = parameters.get("frequency")
    if isinstance(frequency, int | float) and frequency > 0.0:
        return WAVE_SETTLES, WAVE_SETTLES + max(STEADY, BEATS / frequency)
    return SWIM_SETTLES, SWIM_SETTLES + STEADY


def default_range(field: Field, rig: Rig) -> Range | None:
    """What is searched of a parameter unless more is said; None where its bounds leave it open.

    A frequency from `FREQUENCIES` to half beats of `SHORTEST` ticks, an amplitude up to that of
    the rig; an end that is no value itself is moved in by a twentieth.
    """
    parts = field.interval.strip("()[]").split(", ")
    if field.name == "amplitude":
        return Range(field.name, rig.amplitude / 20.0, rig.amplitude)
    if len(parts) != 2 or "inf" in field.interval:
        return None
    low, high = map(float, parts)
    if field.name == "frequency":
        return Range(field.name, max(low, FREQUENCIES), min(high, 0.5 / (SHORTEST * rig.tick)))
    margin = (high - low) / 20.0
    return Range(
        field.name,
        low + margin * field.interval.startswith("("),
        high - margin * field.interval.endswith(")"),
    )
