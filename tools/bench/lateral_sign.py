"""Cost of a reversed F_y, with and without its correction, on fish that differ from the model.

Each fish rests for 3 s and then swims for 40 s, of which the last 30 s count: once unchanged, once
with F_y reversed and corrected, and once with F_y reversed and only a warning. Relative thrust is
the true thrust over that of the best square wave of the same fish.
"""

import logging
import math
import os
import statistics
from argparse import Namespace
from concurrent.futures import ProcessPoolExecutor
from typing import Any, NamedTuple

from bench.swing import percent
from common.report import Options, Report, table
from common.reversed_force import reversed_robot
from fishd.config import load
from fishd.lab.other_fish import CHANGES, OtherFish, harsh_fish, mild
from fishd.lab.simulation import simulate
from fishd.lab.simulation.virtual_run import VirtualRun

DOCUMENT = "how-to/calibration.md"
REST_S = 3.0
"""Time at rest before the start [s]."""
SECONDS, SETTLE = 40.0, 10.0
GROUPS = {
    "the default fish": CHANGES[:1],
    "20 mild fish (seeds 340 to 359)": tuple(map(mild, range(340, 360))),
    "20 harsh fish": harsh_fish(),
}
CONTROLLERS: dict[str, dict[str, Any]] = {
    "swing": {},
    "swing --C auto": {"C": "auto"},
    "default-fish": {"policy": "default-fish"},
}


class Case(NamedTuple):
    """Run of one fish."""

    fish: OtherFish
    contestant: str
    turned: bool
    """Whether F_y is reversed."""
    treatment: str
    """Value of `estimator.reversed_fy`."""


def relative_thrust(case: Case) -> float:
    """Run a fish, and return its relative thrust [1]."""
    logging.getLogger("fishd").setLevel(logging.ERROR)  # each reversed fish causes a warning

    def rest(run: VirtualRun) -> None:
        loop = run.loop
        if case.turned:
            loop.robot = reversed_robot(loop.robot)
        for _ in range(math.ceil(REST_S / loop.limits.tick)):
            run.tick()

    overrides = (*case.fish.overrides, f"estimator.reversed_fy={case.treatment}")
    controller = "ppo" if case.contestant == "default-fish" else "swing"
    parameters = CONTROLLERS[case.contestant]
    config = load(None, overrides)
    return simulate(config, controller, parameters, SECONDS, SETTLE, on_start=rest).relative_thrust


OPTIONS: Options = {
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}
COLUMNS = ((False, "correct"), (True, "correct"), (True, "warn"))


def measure(options: Namespace) -> Report:
    """Return one table; takes a minute or two."""
    cases = [
        Case(fish, contestant, turned, treatment)
        for group in GROUPS.values()
        for fish in group
        for contestant in CONTROLLERS
        for turned, treatment in COLUMNS
    ]
    with ProcessPoolExecutor(options.jobs) as pool:
        shares = dict(zip(cases, pool.map(relative_thrust, cases), strict=True))
    rows = []
    for name, group in GROUPS.items():
        for contestant in CONTROLLERS:
            columns = [
                [shares[Case(fish, contestant, *column)] for fish in group] for column in COLUMNS
            ]
            rows.append([name, f"`{contestant}`", *map(_median_and_worst, columns)])
    head = "fish | controller | F_y right | reversed, `correct` | reversed, `warn`"
    figures = [{**case._asdict(), "relative_thrust": share} for case, share in shares.items()]
    return Report({"bench lateral_sign": table(head, rows)}, figures)


def _median_and_worst(shares: list[float]) -> str:
    median = percent(statistics.median(shares))
    return median if len(shares) == 1 else f"{median} / {percent(min(shares))}"
