"""True thrust of controllers on simulated fish, over that of each fish's best square wave.

A row is a fish, or a group of fish with their median and worst value; a column is a way to swim.

    swing       C = 0.6 and C = auto, on fish that differ from the model as real rigs do
    harsh       the same for each imperfection of config/harsh.yaml, alone and all together
    estimators  `swing` with the model-free estimator and with the observer
    chatter     a policy that reverses too fast, with and without the shortest dwell
"""

import logging
import statistics
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import yaml

from common.report import DOCS, JOBS, QUICK, Options, Report, percent, run_cases, table
from fishd.config import load
from fishd.lab.compare.survey import CHANGES, OtherFish, harsh, harsh_fish, longest_chatter, mild
from fishd.lab.simulation import KeepingPublisher, simulate

OMEGA0, SERVO_SPEED = 12.5, 5.8
"""ω₀ and Ω of the default fish [rad/s]."""
POLICY = {"policy": "default-fish"}


class Way(NamedTuple):
    """Column of a table: a way to swim."""

    name: str
    parameters: Mapping[str, Any] = {}
    overrides: tuple[str, ...] = ()
    controller: str = "swing"
    seconds: float = 60.0
    settle: float = 10.0
    """Length of the start that does not count [s]."""


class Row(NamedTuple):
    """Row of a table: one or several fish, swum with each of the seeds."""

    name: str
    fish: Sequence[OtherFish]
    seeds: Sequence[int | None] = (None,)


class Swum(NamedTuple):
    """Result of a run."""

    relative_thrust: float
    """Thrust over that of the best square wave; 0 after a fault."""
    best: float
    """Thrust of the best square wave [N]."""
    longest_chatter_s: float
    """Longest series of reversals in consecutive ticks [s]."""
    troubled: bool
    """Whether the run ended in a fault, or another controller took over."""


def swim(case: tuple[OtherFish, int | None, Way]) -> Swum:
    """Run one fish in virtual time."""
    fish, seed, way = case
    logging.getLogger("fishd").setLevel(logging.ERROR)
    seeds = () if seed is None else (f"simulation.seed={seed}",)
    config = load(None, (*fish.overrides, *seeds, *way.overrides))
    publisher = KeepingPublisher()

    report = simulate(config, way.controller, way.parameters, way.seconds, way.settle, publisher)
    share = 0.0 if report.reason else report.relative_thrust
    troubled = bool(report.reason or report.fallback)
    longest_chatter_s = longest_chatter(publisher.ticks, 1.5 * config.tick)
    return Swum(share, report.best_square_thrust, longest_chatter_s, troubled)


def swing() -> tuple[list[Row], Sequence[Way]]:
    """Return rows and columns of the part `swing`; nothing was chosen with these seeds."""
    groups = [
        Row("20 harsh fish", harsh_fish()),
        Row("40 other harsh fish (seeds 720 to 759)", tuple(map(harsh, range(720, 760)))),
        Row("40 mild fish (seeds 300 to 339)", tuple(map(mild, range(300, 340)))),
        *(
            Row(
                f"20 weak mild fish (seeds 360 to 379), {amplitude} rad, 2.3 mN noise, a walk",
                tuple(_weak(mild(seed), amplitude) for seed in range(360, 380)),
            )
            for amplitude in (0.15, 0.08)
        ),
    ]
    return [*map(_single, CHANGES), *groups], AUTO


def _weak(fish: OtherFish, amplitude: float) -> OtherFish:
    """Return a fish with a small amplitude [rad] on a bad sensor."""
    sensor = ("simulation.noise=2.3e-3", "simulation.drift_walk=5e-4")
    return OtherFish(fish.name, (*fish.overrides, f"amplitude_limit={amplitude}", *sensor))


def harsh_rig() -> tuple[list[Row], Sequence[Way]]:
    """Return rows and columns of the part `harsh`."""
    file = DOCS.parent / "config" / "harsh.yaml"
    sections = yaml.safe_load(file.read_text(encoding="utf-8"))
    values = {
        f"{section}.{key}": value
        for section in ("plant", "simulation")
        for key, value in sections[section].items()
    }
    named = {key for keys in IMPERFECTIONS.values() for key in keys}
    if named != set(values):
        raise ValueError(f"{file} and IMPERFECTIONS differ by {sorted(named ^ set(values))}")
    rows = [_single(OtherFish("none", ()))]
    for name, keys in {**IMPERFECTIONS, "all of them": tuple(values)}.items():
        overrides = tuple(f"{key}={values[key]!r}" for key in keys)
        rows.append(_single(OtherFish(name, overrides)))
    return rows, (AUTO[0], AUTO[2])


def estimators() -> tuple[list[Row], Sequence[Way]]:
    """Return rows and columns of the part `estimators`; a run has two periods of the drift."""
    rows = []
    for name, overrides in RIGS.items():
        for kind in ("lateral_force", "observer"):
            keys = (*RIG, f"estimator.kind={kind}", *overrides)
            rows.append(Row(f"{name}, {kind}", (OtherFish(name, keys),), range(5)))
    ways = []
    for ratio in (0.1, 0.25, 0.5, 0.9, 1.5, 3.0):
        limit = (f"amplitude_limit={ratio * SERVO_SPEED / OMEGA0}",)
        ways.append(Way(f"ω₀Φ/Ω = {ratio:g}", {}, limit, seconds=140.0, settle=20.0))
    return rows, ways


def chatter(policy: str = POLICY["policy"]) -> tuple[list[Row], Sequence[Way]]:
    """Return rows and columns of the part `chatter`."""
    noise = ("simulation.noise=1e-3", "simulation.offset_y=5e-3")
    rows = []
    for name, parts in SLOW_SERVOS.items():
        fish = OtherFish(name, (*noise, *(f"plant.{part}" for part in parts)))
        rows.append(Row(name, (fish,), range(3)))
    ways = (
        Way("no limit", {"policy": policy}, ("chatter.dwell=0",), "ppo"),
        Way("limit", {"policy": policy}, (), "ppo"),
        Way("`swing`"),
    )
    return rows, ways


def _single(fish: OtherFish) -> Row:
    return Row(fish.name, (fish,))


AUTO = (
    Way("C = 0.6"),
    Way("C = auto, first minute", {"C": "auto"}, settle=0.0),
    Way("C = auto, second minute", {"C": "auto"}, seconds=120.0, settle=60.0),
)
IMPERFECTIONS = {
    "servo delay": ("plant.servo_delay",),
    "servo dead zone": ("plant.servo_dead_zone",),
    "backlash": ("plant.backlash",),
    "cable slack": ("plant.cable_slack",),
    "servo reaction": ("plant.servo_reaction",),
    "lateral drag": ("plant.lateral_drag",),
    "quadratic drag": ("plant.quadratic_drag", "plant.lateral_quadratic_drag"),
    "noise with heavy tails": ("simulation.noise", "simulation.noise_freedom"),
    "hum": ("simulation.hum", "simulation.hum_frequency"),
    "spikes": ("simulation.spike_rate", "simulation.spike_size"),
    "steps of the ADC": ("simulation.quantum",),
    "turned sensor": ("simulation.rotation",),
    "offsets": ("simulation.offset_x", "simulation.offset_y"),
    "drift": ("simulation.drift", "simulation.drift_walk"),
}
"""Configuration keys of each imperfection of config/harsh.yaml."""
RIG = (
    *("simulation.noise=1e-3", "simulation.offset_y=0.02", "simulation.drift=5e-3"),
    "estimator.force_noise=1e-3",
)
RIGS: dict[str, tuple[str, ...]] = {
    "1 mN noise": (),
    "5 mN noise": ("simulation.noise=5e-3", "estimator.force_noise=5e-3"),
    "20 mN drift": ("simulation.drift=0.02",),
    "sensor turned by 5°": ("simulation.rotation=0.0873", "estimator.sensor_rotation=0.0873"),
    "delay of 50 ms": ("plant.servo_delay=0.05",),
    "delay of 100 ms": ("plant.servo_delay=0.1",),
    "drag × 3": ("plant.lateral_drag=0.12",),
}
"""Rigs of the part `estimators`; the observer knows the fish, the rotation and the noise."""
SLOW_SERVOS: dict[str, tuple[str, ...]] = {
    "as configured": (),
    **{f"servo delay {ms} ms": (f"servo_delay={ms / 1000}",) for ms in (30, 50, 80)},
    "backlash ±0.1 rad": ("backlash=0.1",),
    "slack ±0.1 rad": ("cable_slack=0.1",),
    "slack ±0.2 rad": ("cable_slack=0.2",),
    "servo dead zone 0.1 rad": ("servo_dead_zone=0.1",),
    "servo reaction −2 mN s²/rad": ("servo_reaction=-0.002",),
    "servo reaction +4 mN s²/rad": ("servo_reaction=0.004",),
    "30 ms, backlash 0.05, reaction +1": (
        *("servo_delay=0.03", "backlash=0.05", "servo_reaction=0.001"),
    ),
    "50 ms, slack 0.1, reaction −1": (
        *("servo_delay=0.05", "cable_slack=0.1", "servo_reaction=-0.001"),
    ),
    "80 ms, backlash 0.05, dead zone 0.05": (
        *("servo_delay=0.08", "backlash=0.05", "servo_dead_zone=0.05"),
    ),
}


def _measure(
    name: str, cases: Callable[[], tuple[list[Row], Sequence[Way]]], options: Namespace
) -> Report:
    """Swim every fish in every way, and return the table."""
    rows, ways = chatter(options.policy) if name == "chatter" else cases()
    if options.quick:
        rows = [Row(row.name, row.fish[:1], row.seeds[:1]) for row in rows[:2]]
    keys = [
        (number, fish, seed, way)
        for number, row in enumerate(rows)
        for way in ways
        for fish in row.fish
        for seed in row.seeds
    ]
    results = run_cases(swim, [key[1:] for key in keys], options.jobs)
    swims = list(zip(keys, results, strict=True))
    lines = []
    for number, row in enumerate(rows):
        own = [[s for key, s in swims if (key[0], key[3]) == (number, way)] for way in ways]
        best = statistics.median(swum.best for swum in own[0])
        lines.append([row.name, f"{1e3 * best:.2f}", *(_cell(row, column) for column in own)])
    columns = [[swum for key, swum in swims if key[3] == way] for way in ways]
    longest_chatter_s = [
        f"{max(swum.longest_chatter_s for swum in column):.1f}" for column in columns
    ]
    lines.append(["reversals in consecutive ticks, at most, s", "", *longest_chatter_s])
    trouble = [str(sum(swum.troubled for swum in column)) for column in columns]
    lines.append(["runs with a fault or another controller", "", *trouble])
    head = " | ".join(["fish", "best square wave, mN", *(way.name for way in ways)])
    figures = [
        {"fish": fish.name, "seed": seed, "way": way.name, **swum._asdict()}
        for (_, fish, seed, way), swum in swims
    ]
    return Report({f"bench {name}": table(head, lines)}, figures)


def _cell(row: Row, swims: list[Swum]) -> str:
    """Return the median in %, and the worst value for several fish."""
    shares = [swum.relative_thrust for swum in swims]
    median = percent(statistics.median(shares))
    return median if len(row.fish) == 1 else f"{median} / {percent(min(shares))}"


CASES = {
    "swing": swing,
    "harsh": harsh_rig,
    "estimators": estimators,
    "chatter": chatter,
}
PARTS = {name: partial(_measure, name, cases) for name, cases in CASES.items()}
OPTIONS: Options = {
    **JOBS,
    **QUICK,
    "--policy": {"default": POLICY["policy"], "help": "policy of `chatter`: name or file"},
}
