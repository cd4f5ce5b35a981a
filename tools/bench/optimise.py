"""Regret and interval of `fishctl optimise`, on mild fish with noise and drift.

The regret is the thrust lost against the best parameters, which are known only of a simulated fish,
as a share of the largest thrust. A grid of five points that uses the same tank time is the rival:
each of its points swims for a fifth of the time, and the highest measurement wins.
"""

import statistics
from argparse import Namespace
from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from common.report import JOBS, Options, Report, percent, progress, run_cases, table
from fishd.config import Config, load
from fishd.lab.compare.survey import mild
from fishd.lab.measurement import measure as measure_thrust
from fishd.lab.optimise.choice import Choice
from fishd.lab.optimise.search import Range, Search
from fishd.lab.optimise.trials import Aim, measure_trials, restrict_to_whole_ticks
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import simulate
from fishd.virtual.imperfections import SimulationSettings

FIRST_SEED = 93_000
"""First seed of the fish; other seeds were used during development."""
BUDGET_S, MIN_GAIN = 300.0, 0.01
CASES = {
    "C, 1 mN": ("C", 1e-3, 0.0),
    "frequency, 1 mN": ("frequency", 1e-3, 0.0),
    "frequency, 3 mN and a strong walk": ("frequency", 3e-3, 0.02),
}
"""Searched parameter, noise of a tick [N] and drift of the sensor [N]."""
GRID = {"C": (0.0, 0.25, 0.5, 0.75, 1.0), "frequency": (0.5, 1.0, 1.667, 2.5, 4.0)}


class Searched(Struct, frozen=True):
    """Result for one fish."""

    seed: int
    regret: float
    """Share of the largest thrust that is lost."""
    grid_regret: float
    """The same for the grid."""
    error: float
    """Error of the thrust [half-widths of its interval]."""
    half_width: float
    """Half-width of that interval, as a share of the thrust."""
    tank_time: float
    """[s]"""
    is_measured: bool
    """Whether the result was swum at the end."""


def fish(seed: int, noise: float, drift: float) -> Config:
    """Return a mild fish on a noisy rig."""
    config = load(None, mild(seed).overrides)
    return replace(config, simulation=SimulationSettings(noise=noise, drift=drift, seed=seed))


def truth(config: Config, controller: str, parameters: Mapping[str, Any]) -> float:
    """Return the true thrust [N]."""
    return simulate(config, controller, parameters, 40.0, 10.0).mean_thrust


def search_one(task: tuple[str, int]) -> Searched:
    """Search on one fish, and sweep a grid in the same time; task: case and seed."""
    case, seed = task
    name, noise, drift = CASES[case]
    config = fish(seed, noise, drift)
    controller = "swing" if name == "C" else "square"
    searched = Range("C", 0.0, 1.0) if name == "C" else Range("frequency", 0.4, 5.0)
    if name == "frequency":
        searched = restrict_to_whole_ticks(searched, config.tick)
    choice = Choice(Search([searched], seed), Aim(), {}, MIN_GAIN)
    with VirtualSession(config) as session:
        for trial in measure_trials(session, controller, {}, choice.next, BUDGET_S):
            choice.add(trial)
    final = choice.final
    parameters = final.parameters if final else choice.search.propose().parameters
    thrust, ci95 = (final.thrust, final.thrust_ci95) if final else choice.search.propose()[3:5]
    true = truth(config, controller, parameters)
    places = searched.values or tuple(np.linspace(0.0, 1.0, 21))
    best = max(true, *(truth(config, controller, {name: float(place)}) for place in places))
    progress(f"{case}, fish {seed}", f"{parameters} {percent(true / best)}")
    return Searched(
        seed,
        1.0 - true / best,
        1.0 - _best_of_grid(config, controller, name, trial.tank_time) / best,
        (thrust - true) / ci95,
        ci95 / thrust,
        trial.tank_time,
        final is not None,
    )


def _best_of_grid(config: Config, controller: str, name: str, tank_time: float) -> float:
    """Return the true thrust of the point of the grid with the largest measured thrust [N]."""
    measured = {}
    with VirtualSession(config) as session:
        for place in GRID[name]:
            seconds = max(
                tank_time / len(GRID[name]), 20.3 if place >= 1.0 or name == "C" else 35.0
            )
            measured[place] = measure_thrust(session, controller, {name: place}, seconds).thrust
    best = max(measured, key=lambda place: measured[place])
    return truth(config, controller, {name: best})


OPTIONS: Options = {
    **JOBS,
    "--first": {"type": int, "default": FIRST_SEED, "help": "seed of the first fish"},
    "--fish": {"type": int, "default": 60, "help": "number of fish of each case"},
    "--case": {"choices": tuple(CASES), "help": "only this case"},
}


def measure(options: Namespace) -> Report:
    """Return a table; takes some minutes."""
    cases = [options.case] if options.case else list(CASES)
    seeds = range(options.first, options.first + options.fish)
    results = run_cases(
        search_one, [(case, seed) for case in cases for seed in seeds], options.jobs
    )
    rows = []
    for index, case in enumerate(cases):
        these = results[index * options.fish : (index + 1) * options.fish]
        rows.append(
            [
                case,
                *_mean_and_worst([result.regret for result in these]),
                *_mean_and_worst([result.grid_regret for result in these]),
                f"{sum(abs(result.error) <= 1.0 for result in these)} of {len(these)}",
                f"± {percent(statistics.median(result.half_width for result in these))} %",
                f"{statistics.median(result.tank_time for result in these):.0f} s",
                f"{sum(result.is_measured for result in these)} of {len(these)}",
            ]
        )
    head = (
        "search over | mean regret, % | worst, % | grid of five: mean, % | worst, % | interval "
        "contains the truth | median interval | median tank time | optimum was swum"
    )
    errors = {"optimise": [result.error for result in results]}
    return Report({"bench optimise": table(head, rows)}, results, errors=errors)


def _mean_and_worst(regrets: list[float]) -> list[str]:
    return [f"{100.0 * statistics.mean(regrets):.2f}", f"{100.0 * max(regrets):.2f}"]
