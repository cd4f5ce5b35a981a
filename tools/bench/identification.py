"""Errors of `fishctl identify` and coverage of its intervals, on known fish.

Each fish swims one experiment of three minutes in virtual time, measured with noise, a rotated
sensor, offsets and drift. Every fit begins with the default fish. With `--on virtual-pi`, the true
drivers measure and move the fish; the phase of the servo's pulses differs from fish to fish.
"""

import random
from argparse import Namespace
from collections.abc import Sequence
from math import radians
from typing import Any, NamedTuple

import msgspec
import numpy as np

from common.report import JOBS, Options, Report, run_cases, table
from fishd.config import Config, load
from fishd.core.calibration import EXACT
from fishd.lab.compare.survey import harsh
from fishd.lab.identification import experiment, identify
from fishd.lab.identification.summary import SCALED
from fishd.lab.session import VirtualSession
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.pulse_train import SERVO_FRAME
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.tank import STEP
from fishd.virtual.plant.parameters import PlantParameters

RIG = SimulationSettings(noise=1e-3, rotation=radians(5), offset_x=0.02, offset_y=0.02, drift=5e-3)
SPREAD = 0.3
"""Largest relative difference of the other fish from the default one, in each of `VARIED`."""
VARIED = (
    "omega0", "xi", "coupling", "servo_speed", "servo_lag", "thrust_coefficient", "lateral_drag",
)  # fmt: skip
MAX_DELAY_S, MAX_BACKLASH_RAD = 0.1, 0.05
"""Largest delay of the servo [s], and largest backlash [rad]."""
MAX_PI_DELAY_S = 0.03
"""Largest delay of the servo on a virtual Pi, without the wait for a pulse [s]."""
MAX_DRAG, MAX_LATERAL_DRAG = 2.0, 0.01
"""Largest quadratic drag of the fin [1/rad], and in F_y [N s²/rad²]."""
RATIOS = (0.6, 0.85, 1.15, 1.6)
"""Ranges of K_y/K: between the first two, or between the last two."""
FIRST_SEED = {"other": 51000, "outside": 52000, "harsh": 900, "pi": 53000}
"""Seed of the first fish of each kind, and of its sensor."""
SECONDS = 180.0
ABSOLUTE = {
    "servo_delay": (1e3, "ms"),
    "backlash": (1e3, "mrad"),
    "quadratic_drag": (1.0, "1/rad"),
    "lateral_quadratic_drag": (1e3, "mN s²/rad²"),
}
"""Quantities with absolute errors; all others have errors relative to the true value."""


KINDS = {
    "other": "other fish, with delay and backlash",
    "outside": "the same with quadratic drag and K_y ≠ K",
    "harsh": "harsh fish: dead zone and reaction, too; K_y = K",
    "pi": "other fish behind the drivers of a virtual Pi",
}
"""Kinds of fish, with their names in the table."""

EQUALLY_FITTED = ("other", "outside", "pi")
"""Kinds whose fits all have the same parameters, except those that the data require."""


class Interval(NamedTuple):
    """Estimate of a parameter of a known fish."""

    truth: float
    value: float
    low: float
    high: float
    known_low: float
    """Lower end of the interval for a known K_y/K."""
    known_high: float


class Outcome(NamedTuple):
    """Result of one experiment."""

    intervals: dict[str, Interval]
    trusted: bool
    """Whether the first line of the output has no warning."""


def fish(kind: str, seed: int) -> Config:
    """Return a known fish of one of `KINDS`, and its rig."""
    if kind == "harsh":
        return load(None, harsh(FIRST_SEED[kind] + seed).overrides)
    rig = msgspec.structs.replace(RIG, seed=FIRST_SEED[kind] + seed)
    chance = random.Random(FIRST_SEED[kind] + seed)
    plain = msgspec.structs.asdict(PlantParameters())
    varied = {name: plain[name] * chance.uniform(1 - SPREAD, 1 + SPREAD) for name in VARIED}
    varied["servo_delay"] = chance.uniform(0.0, MAX_PI_DELAY_S if kind == "pi" else MAX_DELAY_S)
    varied["backlash"] = chance.uniform(0.0, MAX_BACKLASH_RAD)
    if kind == "outside":
        varied["quadratic_drag"] = chance.uniform(0.0, MAX_DRAG)
        varied["lateral_quadratic_drag"] = chance.uniform(0.0, MAX_LATERAL_DRAG)
        side = chance.choice((RATIOS[:2], RATIOS[2:]))
        varied["lateral_inertia_ratio"] = chance.uniform(*side)
    plant = PlantParameters(**varied)
    if kind != "pi":
        return Config(plant=plant, simulation=rig)
    # The virtual Pi computes in whole steps.
    pi = VirtualPiSettings(pulse_lead=chance.randrange(round(SERVO_FRAME / STEP)) * STEP)
    return Config(robot="virtual-pi", plant=plant, simulation=rig, virtual_pi=pi)


def mean_wait(config: Config) -> float:
    """Return the mean time from a tick until the next pulse of a virtual Pi [s]."""
    ticks = np.arange(round(SECONDS / config.tick)) * config.tick
    # In whole steps, so that no rounding makes a wait of 0 one of a whole frame.
    steps = np.rint((config.virtual_pi.pulse_lead + ticks) / STEP).astype(int)
    waits = STEP * np.mod(-steps, round(SERVO_FRAME / STEP))
    return float(waits.mean()) if config.robot == "virtual-pi" else 0.0


def one(run: tuple[str, int]) -> Outcome:
    """Run one fish, and identify it."""
    kind, seed = run
    config = fish(kind, seed)
    with VirtualSession(config, EXACT) as swum:
        identification = identify(experiment(swum, SECONDS), servo=swum.servo)
    truth: dict[str, Any] = msgspec.structs.asdict(config.plant)
    truth["servo_delay"] += mean_wait(config)
    truth |= msgspec.structs.asdict(config.simulation)
    # Nearly three whole periods of the drift, so that its mean is almost zero.
    intervals = {
        each.name: Interval(
            truth[each.name], each.value, each.ci95_low, each.ci95_high, *each.narrowest_interval
        )
        for each in identification.estimates
        if each.fitted
    }
    return Outcome(intervals, identification.headline.startswith("identified"))


def rows(outcomes: Sequence[Outcome], *, known: bool) -> list[list[str]]:
    """Return one row for each quantity of all fits: errors, width, coverage.

    known: K_y/K is, so that intervals for it are meant
    """
    cells = []
    for name in outcomes[0].intervals:
        if any(name not in outcome.intervals for outcome in outcomes):
            continue  # what only some of the data demand
        intervals = [outcome.intervals[name] for outcome in outcomes]
        truth, value, low, high, known_low, known_high = np.array(intervals).T
        if known:
            low, high = known_low, known_high
        is_absolute = name in ABSOLUTE
        factor, unit = ABSOLUTE.get(name, (100.0, "%"))
        scale = factor if is_absolute else factor / np.abs(truth)
        error, width = np.abs(value - truth) * scale, 0.5 * (high - low) * scale
        covered = int(np.sum((low <= truth) & (truth <= high)))
        cells.append(
            [
                f"`{name}`",
                *(f"{x:.2g} {unit}" for x in (np.median(error), error.max(), np.median(width))),
                f"{covered} of {len(intervals)}",
            ]
        )
    return cells


def summary(kind: str, outcomes: Sequence[Outcome]) -> list[str]:
    """Return the row of one kind of fish."""
    known = kind != "outside"
    held = narrow = count = astray = withheld = own = own_held = 0
    errors, worst = [], 0.0
    for outcome in outcomes:
        for name, each in outcome.intervals.items():
            if not np.isfinite(each.high):
                withheld += 1
                continue
            count += 1
            holds = each.low <= each.truth <= each.high
            held += holds
            if name not in SCALED:
                own, own_held = own + 1, own_held + holds
            narrow += each.known_low <= each.truth <= each.known_high
            off = abs(each.truth - 0.5 * (each.low + each.high)) / (0.5 * (each.high - each.low))
            worst = max(worst, off)
            astray += outcome.trusted and off > 2.0
            if known and name in VARIED:
                errors.append(100.0 * abs(each.value / each.truth - 1.0))
    return [
        KINDS[kind],
        f"{held} of {count} ({held / max(1, count):.0%})",
        f"{own_held} of {own}",
        str(withheld),
        f"{narrow} of {count}" if known else "–",
        f"{np.median(errors):.2g} %" if known else "–",
        f"{sum(not outcome.trusted for outcome in outcomes)} of {len(outcomes)}",
        f"{worst:.2g}",
        str(astray),
    ]


SUMMARY = (
    "fish | intervals that contain the true value | the same, not scaled by K_y/K | withheld | "
    "the same, K_y/K known | median error | fits with a warning | largest error, half-widths | "
    "errors above 2 half-widths without a warning"
)
HEAD = (
    "quantity | median error | largest error | half-width of the 95 % interval | "
    "contains the true value"
)
OPTIONS: Options = {
    "--seeds": {
        "type": int,
        "default": 10,
        "help": "experiments of each kind, half as many harsh ones; default 10",
    },
    "--on": {
        "choices": ("simulation", "virtual-pi"),
        "default": "simulation",
        "help": "where the fish swim; default simulation",
    },
    **JOBS,
}


def measure(options: Namespace) -> Report:
    """Return the tables; each experiment takes some seconds."""
    sections, figures, whole = {}, {}, []
    kinds = ["pi"] if options.on == "virtual-pi" else [kind for kind in KINDS if kind != "pi"]
    for kind in kinds:
        seeds = options.seeds if kind in EQUALLY_FITTED else (options.seeds + 1) // 2
        outcomes = run_cases(one, [(kind, seed) for seed in range(seeds)], options.jobs)
        whole.append(summary(kind, outcomes))
        figures[kind] = [outcome._asdict() for outcome in outcomes]
        if kind in EQUALLY_FITTED:
            lines = rows(outcomes, known=kind != "outside")
            sections[f"bench identification {kind}"] = table(HEAD, lines)
    part = "virtual-pi" if kinds == ["pi"] else "summary"
    sections[f"bench identification {part}"] = table(SUMMARY, whole)
    return Report(sections, figures)
