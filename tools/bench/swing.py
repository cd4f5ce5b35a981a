"""`swing --C auto` on fish that differ from the model: beside C = 0.6, after a minute and before.

The single changes are those of a real rig, one at a time. The harsh fish have all of them, in
random sizes. Efficiencies are shares of each fish's own best square wave, of its true thrust.
"""

import math
import os
import random
import statistics
from argparse import Namespace
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

from common.report import BrokenPromise, Options, Report, table
from fishd.config import Config, load
from fishd.simulation import simulate

DOCUMENT = "swing-efficiency.md"
FIRST_SEED = 300
"""Of the harsh fish; those below were looked at while the search was made."""
FISH = 20
LEARNT = 60.0
"""The search is judged after so long [s]."""
SECONDS = 120.0
RATIOS = (0.1, 0.25, 0.5, 0.9, 1.5, 2, 3)
"""ω₀Φ/Ω."""


class Case(NamedTuple):
    """A fish, by the keys in which it differs from the model."""

    name: str
    overrides: tuple[str, ...]


DRAG, INERTIA, OMEGA0, AMPLITUDE = 39.9e-3, 12.9e-3, 12.5, 0.42
CHANGES = (
    Case("none", ()),
    Case("backlash 0.15 rad", ("plant.backlash=0.15",)),
    Case("dead zone 0.15 rad", ("plant.servo_dead_zone=0.15",)),
    *(Case(f"servo delay {ms} ms", (f"plant.servo_delay={ms / 1000}",)) for ms in (20, 40, 80)),
    Case("servo reaction 6e-3 N s²/rad", ("plant.servo_reaction=6e-3",)),
    *(Case(f"K_d × {times}", (f"plant.lateral_drag={times * DRAG}",)) for times in (3, 10)),
)


def at_ratio(ratio: float) -> Case:
    """The model with another servo."""
    speed = OMEGA0 * AMPLITUDE / ratio
    return Case(f"ω₀Φ/Ω = {ratio:g}", (f"plant.servo_speed={speed}",))


def harsh(seed: int) -> Case:
    """A fish with all of it, in random sizes."""
    uniform = random.Random(seed).uniform
    plant = {
        "omega0": uniform(8.0, 18.0),
        "xi": uniform(0.6, 1.8),
        "coupling": uniform(0.35, 0.6),
        "servo_speed": uniform(4.0, 9.0),
        "servo_lag": uniform(0.15, 0.4),
        "thrust_coefficient": INERTIA * uniform(0.6, 1.6),
        "lateral_drag": DRAG * math.exp(uniform(math.log(0.5), math.log(3.0))),
        "backlash": uniform(0.0, 0.08),
        "servo_delay": uniform(0.0, 0.05),
        "servo_dead_zone": uniform(0.0, 0.03),
        "servo_reaction": uniform(-2e-3, 3e-3),
    }
    rig = {
        "noise": uniform(0.5e-3, 2e-3),
        "rotation": uniform(-0.17, 0.17),
        "drift": uniform(0.0, 5e-3),
        "offset_y": uniform(-0.02, 0.02),
        "offset_x": uniform(-0.02, 0.02),
        "seed": seed,
    }
    keys = [f"plant.{name}={value!r}" for name, value in plant.items()]
    keys += [f"simulation.{name}={value!r}" for name, value in rig.items()]
    return Case(f"harsh {seed}", tuple(keys))


class Shares(NamedTuple):
    """Of the best square wave."""

    fixed: float
    """C = 0.6."""
    first: float
    """C = auto in its first minute."""
    auto: float
    """C = auto in the second one."""


def measured(case: Case) -> Shares:
    """Swim it three times."""
    config: Config = load(None, case.overrides)

    def share(C: float | str, seconds: float, settle: float) -> float:
        report = simulate(config, "swing", {"C": C}, seconds, settle)
        if report.reason:
            raise BrokenPromise(f"{case.name}: {report.reason.message}")
        return report.efficiency

    return Shares(
        share(0.6, LEARNT, 10.0), share("auto", LEARNT, 0.0), share("auto", SECONDS, LEARNT)
    )


OPTIONS: Options = {
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


def measure(options: Namespace) -> Report:
    """One table; a minute."""
    fish = [harsh(FIRST_SEED + k) for k in range(FISH)]
    cases = [*CHANGES, *map(at_ratio, RATIOS), *fish]
    with ProcessPoolExecutor(options.jobs) as pool:
        found = dict(zip(cases, pool.map(measured, cases), strict=True))
    rows = [[case.name, *map(percent, found[case])] for case in cases if case not in fish]
    for name, pick in (("median", statistics.median), ("worst", min)):
        shares = [pick(column) for column in zip(*(found[case] for case in fish), strict=True)]
        rows.append([f"{FISH} harsh fish, {name}", *map(percent, shares)])
    head = "change | C = 0.6 | auto, first minute | auto, second minute"
    figures = {case.name: found[case]._asdict() for case in cases}
    return Report({"bench swing": table(head, rows)}, figures)


def percent(share: float) -> str:
    """With one decimal."""
    return f"{100 * share:.1f}"
