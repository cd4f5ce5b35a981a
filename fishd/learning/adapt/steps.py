"""The steps of an adaptation that need the fish: excitation, swing's search, square waves."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace

from fishd.lab.identification import DEFAULT, Identification, Unidentifiable, identify
from fishd.lab.measurement import MEAN_REST_S, MEAN_SWIM_S
from fishd.lab.measurement import plan as plan_of
from fishd.lab.optimise.search import Range, Search
from fishd.lab.optimise.trials import (
    Trial,
    measure_trials,
    restrict_to_whole_ticks,
    trial_durations,
)
from fishd.lab.session import Session
from fishd.learning.adapt.cloud import draw_cloud, identified_fish
from fishd.learning.adapt.prior import (
    combine,
    correlation_of_waves,
    deviations,
    is_rejected,
    model_of,
)
from fishd.learning.adapt.state import Fitted, Rung, Tried
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.optimum import best_square_wave, square_wave

FITTED = (*DEFAULT, "lateral_quadratic_drag", "servo_dead_zone", "servo_reaction")
"""Fitted parameters: all that a fit can find except slack, which backlash represents."""
MIN_EXPLAINED = 0.1
"""Smallest explained share of a force; below it the force is mostly noise: the fit is rejected."""
SEARCH_RATIO = 2.0
"""Factor of the search range of square waves, below and above the best of the identified fish."""
MIN_FREQUENCY_HZ, MAX_FREQUENCY_HZ = 0.3, 8.0
"""Bounds of the search of square waves, whatever the fit [Hz]."""
BUDGET = {"excitation": 0.2, "swing": 0.14, "search": 0.2}
"""Shares of the tank time; the comparison uses the remainder."""
MIN_TANK_TIME_S = 150.0
"""Shortest tank time [s]: its excitation takes 30 s, the shortest that a fit accepts."""


def fit(recording: Path, amplitude: float, seed: int) -> tuple[Identification, Fitted]:
    """Fit a fish to a recorded excitation, without prior knowledge; return it and its cloud.

    amplitude: Φ [rad]
    Raises `Unidentifiable`, also where the fit explains less than `MIN_EXPLAINED` of a force.
    """
    identification = identify([recording], fit=FITTED)
    for channel, symbol in zip(identification.channels, ("F_x", "F_y"), strict=True):
        if not channel.explained >= MIN_EXPLAINED:
            raise Unidentifiable(
                f"the best fit explains {max(0.0, channel.explained):.0%} of {symbol} only: the "
                "forces are mostly noise, or do not follow the commands; see "
                "fishctl plot and fishctl identify with --plot"
            )
    plant = identified_fish(identification)
    model = model_of(identification)
    if not best_square_wave(plant, amplitude).thrust > 0.0:
        model = replace(model, error=None)
    offset, drift = identification["offset_y"], identification.channels[1].drift
    fitted = Fitted(
        plant=plant,
        rig=msgspec.convert(identification.simulation, SimulationSettings),
        offset=max(offset.high - offset.value, 0.5 * drift),
        cloud=draw_cloud(identification, seed),
        model=model,
        found=identification.to_builtins(),
    )
    return identification, fitted


def settle_swing(session: Session, seconds: float) -> Rung:
    """Let `swing --C auto` search for `seconds`; return its final C and lead."""
    ticks = session.swim("swing", {"C": "auto"}, seconds)
    session.rest(MEAN_REST_S)
    end = ticks[len(ticks) // 2 :]
    shown = [tick.quantities for tick in end if tick.quantities]
    watching = [quantities for quantities in shown if not quantities["searching"]]
    # If the search is not over, the rung between the trials is the most frequent one.
    rungs = Counter(
        (quantities["criterion"], quantities["lead"]) for quantities in watching or shown
    )
    (criterion, lead), _ = rungs.most_common(1)[0]
    return Rung(criterion, lead, bool(watching))


def square_waves(fitted: Fitted, session: Session, seed: int) -> Search:
    """Return a search over square waves of whole ticks around the best of the identified fish.

    Where the fish explains too little, all frequencies are searched.
    """
    low, high = MIN_FREQUENCY_HZ, MAX_FREQUENCY_HZ
    if fitted.model.error is not None:
        best = best_square_wave(fitted.plant, session.amplitude).frequency
        best = min(MAX_FREQUENCY_HZ / SEARCH_RATIO, max(MIN_FREQUENCY_HZ * SEARCH_RATIO, best))
        low, high = best / SEARCH_RATIO, best * SEARCH_RATIO
    high = min(high, 0.5 / session.tick)
    return Search([restrict_to_whole_ticks(Range("frequency", low, high), session.tick)], seed)


def search_square_waves(
    session: Session,
    search: Search,
    budget: float,
    before: Sequence[Tried],
    add_trial: Callable[[Tried], None],
) -> None:
    """Try square waves until the budget is used [s].

    before: square waves tried already; add_trial: called with each new one
    """
    last = None
    for tried in before:
        power = math.nan, math.nan  # the electrical power is unknown
        last = Trial(
            {"frequency": tried.frequency},
            tried.thrust,
            tried.error,
            *power,
            tried.swum,
            tried.passed,
        )
        search.observe(last.parameters, last.thrust, last.error)
    for trial in measure_trials(session, "square", {}, search, budget, last):
        frequency = trial.parameters["frequency"]
        add_trial(Tried(frequency, trial.thrust, trial.error, trial.swum, trial.passed))


def best_of(
    search: Search, tried: Sequence[Tried], fitted: Fitted, amplitude: float
) -> tuple[float, bool]:
    """Return the frequency of the best square wave [Hz], and whether the identified fish is used.

    The curve of the identified fish is based on a whole excitation, so it is more exact than a few
    noisy trials. Its weight depends on how well it explains the forces. Where it explains too
    little, or the trials disagree with it, only the search is used.
    """
    frequencies = search.ranges[0].values
    if fitted.model.error is not None:
        curves = np.array(
            [
                [square_wave(plant, amplitude, f).thrust for f in frequencies]
                for plant in fitted.cloud
            ]
        )
        spread = deviations(curves, fitted.model.error, correlation_of_waves(frequencies))
        places = [int(np.argmin(np.abs(np.subtract(frequencies, t.frequency)))) for t in tried]
        measured = np.array([trial.thrust for trial in tried])
        ci95 = np.array([trial.error for trial in tried])
        if not is_rejected(curves[0], spread, places, measured, ci95):
            thrusts, _ = combine(curves[0], spread, places, measured, ci95)
            return frequencies[int(np.argmax(thrusts))], True
    return search.propose().parameters["frequency"], False


def min_search_time(session: Session, search: Search) -> float:
    """Return the time of a search that tries the slowest wave once [s]."""
    return (
        2.0 * MEAN_REST_S
        + trial_durations({"frequency": search.ranges[0].values[0]})[1]
        + session.tick
    )


def min_measurement_time(parameters: Mapping[str, Any]) -> float:
    """Return the shortest time in which a gait can be measured, rests included [s]."""
    frequency = float(parameters.get("frequency", 0.0))
    swim = max(MEAN_SWIM_S, 1.5 + 3.0 / frequency) if frequency else MEAN_SWIM_S
    seconds = 2.0 * swim + 3.0 * MEAN_REST_S
    plan_of(seconds + 1e-6, parameters)
    return seconds + 1e-6
