"""`swing --C auto` on fish that differ from the model: beside C = 0.6, after a minute and before.

The single changes are those of a real rig, one at a time. The harsh fish have all of them, in
random sizes; the mild ones are as random, on clean rigs. Relative thrusts are shares of each fish's
own best square wave, of its true thrust.
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
LEARNT = 60.0
"""The search is judged after so long [s]."""
SECONDS = 120.0
RATIOS = (0.1, 0.25, 0.5, 0.9, 1.5, 2, 3)
"""ω₀Φ/Ω."""


OMEGA0, AMPLITUDE = 12.5, 0.42
GROUPS = {
    "20 harsh fish": harsh_fish(),
    "40 other harsh fish (seeds 720 to 759)": tuple(map(harsh, range(720, 760))),
    "40 mild fish (seeds 300 to 339)": tuple(map(mild, range(300, 340))),
}
"""Random fish; nothing was chosen with those that have their seeds here."""


def at_ratio(ratio: float) -> OtherFish:
    """The model with another servo."""
    speed = OMEGA0 * AMPLITUDE / ratio
    return OtherFish(f"ω₀Φ/Ω = {ratio:g}", (f"plant.servo_speed={speed}",))


class Shares(NamedTuple):
    """Of the best square wave."""

    fixed: float
    """C = 0.6."""
    first: float
    """C = auto in its first minute."""
    auto: float
    """C = auto in the second one."""


def measured(case: OtherFish) -> Shares:
    """Swim it three times."""
    config: Config = load(None, case.overrides)

    def share(C: float | str, seconds: float, settle: float) -> float:
        report = simulate(config, "swing", {"C": C}, seconds, settle)
        if report.reason:
            raise BrokenPromise(f"{case.name}: {report.reason.message}")
        return report.relative_thrust

    return Shares(
        share(0.6, LEARNT, 10.0), share("auto", LEARNT, 0.0), share("auto", SECONDS, LEARNT)
    )


OPTIONS: Options = {
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


def measure(options: Namespace) -> Report:
    """One table; a minute or two."""
    single = [*CHANGES, *map(at_ratio, RATIOS)]
    cases = [*single, *chain.from_iterable(GROUPS.values())]
    with ProcessPoolExecutor(options.jobs) as pool:
        found = dict(zip(cases, pool.map(measured, cases), strict=True))
    rows = [[case.name, *map(percent, found[case])] for case in single]
    for group, fish in GROUPS.items():
        for name, pick in (("median", statistics.median), ("worst", min)):
            shares = [pick(column) for column in zip(*(found[case] for case in fish), strict=True)]
            rows.append([f"{group}, {name}", *map(percent, shares)])
    head = "change | C = 0.6 | auto, first minute | auto, second minute"
    figures = {case.name: found[case]._asdict() for case in cases}
    return Report({"bench swing": table(head, rows)}, figures)


def percent(share: float) -> str:
    """With one decimal."""
    return f"{round(100 * share, 1) + 0.0:.1f}"  # no negative zero
