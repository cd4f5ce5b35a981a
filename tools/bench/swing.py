"""`swing --C auto` on fish that differ from the model, compared with C = 0.6.

The single changes are those of a real rig, one at a time. The harsh fish have all of them, in
random sizes; the mild fish are equally random, on clean rigs. Relative thrust is the true thrust
over that of the best square wave of the same fish.
"""

import os
import statistics
from argparse import Namespace
from concurrent.futures import ProcessPoolExecutor
from itertools import chain
from typing import NamedTuple

from common.report import BrokenPromise, Options, Report, table
from fishd.config import Config, load
from fishd.lab.other_fish import CHANGES, OtherFish, harsh, harsh_fish, mild
from fishd.lab.simulation import simulate

DOCUMENT = "explanation/swing-efficiency.md"
LEARNING_TIME_S = 60.0
"""Time after which the search is evaluated [s]."""
SECONDS = 120.0
RATIOS = (0.1, 0.25, 0.5, 0.9, 1.5, 2, 3)
"""Values of ω₀Φ/Ω."""


OMEGA0, AMPLITUDE = 12.5, 0.42
GROUPS = {
    "20 harsh fish": harsh_fish(),
    "40 other harsh fish (seeds 720 to 759)": tuple(map(harsh, range(720, 760))),
    "40 mild fish (seeds 300 to 339)": tuple(map(mild, range(300, 340))),
}
"""Seeds of random fish; nothing was chosen with these seeds."""


def at_ratio(ratio: float) -> OtherFish:
    """Return the model with another servo."""
    speed = OMEGA0 * AMPLITUDE / ratio
    return OtherFish(f"ω₀Φ/Ω = {ratio:g}", (f"plant.servo_speed={speed}",))


class Shares(NamedTuple):
    """Thrusts relative to the best square wave."""

    fixed: float
    """Relative thrust with C = 0.6."""
    first: float
    """Relative thrust with C = auto in the first minute."""
    auto: float
    """Relative thrust with C = auto in the second minute."""


def measured(case: OtherFish) -> Shares:
    """Run the fish three times."""
    config: Config = load(None, case.overrides)

    def share(C: float | str, seconds: float, settle: float) -> float:
        report = simulate(config, "swing", {"C": C}, seconds, settle)
        if report.reason:
            raise BrokenPromise(f"{case.name}: {report.reason.message}")
        return report.relative_thrust

    return Shares(
        share(0.6, LEARNING_TIME_S, 10.0),
        share("auto", LEARNING_TIME_S, 0.0),
        share("auto", SECONDS, LEARNING_TIME_S),
    )


OPTIONS: Options = {
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


def measure(options: Namespace) -> Report:
    """Return one table; takes a minute or two."""
    single = [*CHANGES, *map(at_ratio, RATIOS)]
    cases = [*single, *chain.from_iterable(GROUPS.values())]
    with ProcessPoolExecutor(options.jobs) as pool:
        shares_by_case = dict(zip(cases, pool.map(measured, cases), strict=True))
    rows = [[case.name, *map(percent, shares_by_case[case])] for case in single]
    for group, fish in GROUPS.items():
        for name, pick in (("median", statistics.median), ("worst", min)):
            shares = [
                pick(column)
                for column in zip(*(shares_by_case[case] for case in fish), strict=True)
            ]
            rows.append([f"{group}, {name}", *map(percent, shares)])
    head = "change | C = 0.6 | auto, first minute | auto, second minute"
    figures = {case.name: shares_by_case[case]._asdict() for case in cases}
    return Report({"bench swing": table(head, rows)}, figures)


def percent(share: float) -> str:
    """Format a fraction in % with one decimal."""
    return f"{round(100 * share, 1) + 0.0:.1f}"  # no negative zero
