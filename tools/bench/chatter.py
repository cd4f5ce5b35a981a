"""Effect of the shortest dwell: a policy on fish that make it reverse too fast.

Each fish swims for a minute from rest in virtual time, with each seed of the noise: with
`chatter.dwell: 0`, with the defaults, and with `swing` for comparison. About half a minute.
"""

import statistics
from argparse import Namespace
from collections.abc import Iterable
from typing import NamedTuple

from common.report import Options, Report, progress, table
from fishd.config import Config, load
from fishd.controllers import registry
from fishd.lab.compare.survey import ReversalTimes
from fishd.lab.simulation import judge

DOCUMENT = "reference/policies.md"
RIG = ("simulation.noise=1e-3", "simulation.offset_y=5e-3")
HARSH = {
    "servo delay 30 ms": ("servo_delay=0.03",),
    "servo delay 50 ms": ("servo_delay=0.05",),
    "servo delay 80 ms": ("servo_delay=0.08",),
    "backlash ±0.1 rad": ("backlash=0.1",),
    "slack ±0.1 rad": ("cable_slack=0.1",),
    "slack ±0.2 rad": ("cable_slack=0.2",),
    "servo dead zone 0.1 rad": ("servo_dead_zone=0.1",),
    "servo reaction −2 mN s²/rad": ("servo_reaction=-0.002",),
    "servo reaction +4 mN s²/rad": ("servo_reaction=0.004",),
    "30 ms, backlash 0.05, reaction +1": (
        "servo_delay=0.03",
        "backlash=0.05",
        "servo_reaction=0.001",
    ),
    "50 ms, slack 0.1, reaction −1": (
        "servo_delay=0.05",
        "cable_slack=0.1",
        "servo_reaction=-0.001",
    ),
    "80 ms, backlash 0.05, dead zone 0.05": (
        "servo_delay=0.08",
        "backlash=0.05",
        "servo_dead_zone=0.05",
    ),
}
SECONDS, SETTLE = 60.0, 10.0
FAST = 0.2
"""Time between two reversals below which they count as fast [s]."""


class Swum(NamedTuple):
    """Result of one run."""

    relative_thrust: float
    every_tick: float
    """Longest stretch of reversals in consecutive ticks [s]."""
    fast: float
    """Longest stretch of reversals less than `FAST` apart [s]."""
    fell_back: bool


def swim(config: Config, name: str, parameters: dict[str, str]) -> Swum:
    """Run a controller on a fish, and return the result."""
    reversals = ReversalTimes()
    controller = registry.create(name, parameters, config.limits)
    report = judge(config, name, controller, SECONDS, SETTLE, reversals)
    return Swum(
        report.relative_thrust,
        reversals.longest(1.5 * config.tick),
        reversals.longest(FAST - 0.5 * config.tick),
        report.fallback is not None,
    )


def swum(changes: Iterable[str], name: str, parameters: dict[str, str], seeds: int) -> list[Swum]:
    """Return the results of `swim` for several seeds of the noise."""
    return [
        swim(load(None, [*RIG, f"simulation.seed={seed}", *changes]), name, parameters)
        for seed in range(seeds)
    ]


HEAD = (
    f"fish | no limit [%] | every tick [s] | < {FAST:g} s [s] | limit [%] | every tick [s] | "
    f"< {FAST:g} s [s] | fell back | `swing` [%]"
)


OPTIONS: Options = {
    "--policy": {"default": "default-fish", "help": "name or file"},
    "--seeds": {"type": int, "default": 3, "help": "runs of each (3)"},
}


def measure(options: Namespace) -> Report:
    """Return the table of all fish."""
    seeds = options.seeds
    fish = {"as configured": (), **HARSH}
    ppo = {"policy": options.policy}
    rows, without, limited, swing = [], [], [], []
    for label, parts in fish.items():
        changes = [f"plant.{part}" for part in parts]
        free = swum([*changes, "chatter.dwell=0"], "ppo", ppo, seeds)
        held = swum(changes, "ppo", ppo, seeds)
        other = swum(changes, "swing", {}, seeds)
        if parts:
            without += free
            limited += held
            swing += other
        rows.append(
            [
                label,
                relative_thrust(free),
                f"{max(run.every_tick for run in free):.1f}",
                f"{max(run.fast for run in free):.1f}",
                relative_thrust(held),
                f"{max(run.every_tick for run in held):.1f}",
                f"{max(run.fast for run in held):.1f}",
                f"{sum(run.fell_back for run in held)} of {seeds}",
                relative_thrust(other),
            ]
        )
        progress(*rows[-1])
    text = (
        f"{table(HEAD, rows)}\n\nThe {len(HARSH)} harsh fish, {len(without)} runs each, median "
        f"(lowest): without the limit {spread(without)}, with it {spread(limited)}, `swing` "
        f"{spread(swing)}."
    )
    return Report({"bench chatter": text}, rows)


def relative_thrust(runs: list[Swum]) -> str:
    """Return the median in % for a cell."""
    return f"{statistics.median(run.relative_thrust for run in runs) * 100:.1f}"


def spread(runs: list[Swum]) -> str:
    """Return median and lowest value."""
    lowest = min(run.relative_thrust for run in runs)
    return f"{relative_thrust(runs)} % ({lowest * 100:.1f} %)"
