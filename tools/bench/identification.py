"""Errors of `fishctl identify` and coverage of its intervals, on known fish.

Each fish swims one experiment of three minutes in virtual time, measured with noise, a rotated
sensor, offsets and drift. Every fit begins with the default fish. With `--kind foreign`, the fish
are those of `common/foreign_fish.py`, another implementation of the equations with other servos.
With `--on virtual-pi`, the true drivers measure and move the fish; the phase of the servo's pulses
differs from fish to fish.
"""

import random
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Sequence
from math import isfinite, radians
from typing import Any, NamedTuple

import msgspec
import numpy as np

from common.foreign_fish import MODEL, ForeignParameters, register
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
from fishd.virtual.plant.servo_law import LAWS

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
FIRST_SEED = {"other": 51000, "outside": 52000, "harsh": 900, "foreign": 53000, "pi": 54000}
"""Seed of the first fish of each kind, and of its sensor."""
FOREIGN_KINDS = (
    *LAWS, "backlash", "dead zone", "delay", "asymmetry", "backlash and dead zone", "all of these",
    "quadratic drag", "K_y/K from 0.25 to 0.5", "K_y/K from 2 to 4", "all, K_y/K from 2 to 4",
)  # fmt: skip
"""Kinds of foreign fish, in turn; those that are not named after a law have each in turn."""
FOREIGN_COUNT = 40
"""Number of foreign fish."""
HELD = 1.0 + 1e-9
"""Largest error of a true value in its interval, whose end may be zero, in half-widths."""
FAR = 2.5
"""Error that the first line of the output must warn of, in half-widths of the interval."""
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
    verdict: str
    """First words of the output: identified, careful or not identified."""
    seconds: float
    """Processor time of the fit [s]."""

    @property
    def trusted(self) -> bool:
        """Whether the first line of the output has no warning."""
        return self.verdict == "identified"

    @property
    def errors(self) -> list[float]:
        """Errors of all intervals that are not withheld, from their middles, in half-widths."""
        return [_error(each) for each in self.intervals.values() if isfinite(each.high)]

    @property
    def strict_errors(self) -> list[float]:
        """The same without intervals that can hardly miss, for the assumed range of K_y/K and of
        parameters that are truly zero, which is the end of their interval."""
        return [
            _error(each)
            for name, each in self.intervals.items()
            if isfinite(each.high) and name not in SCALED and not each.truth == 0.0 == each.low
        ]


def _error(interval: Interval) -> float:
    """Return the distance of the truth from the middle of an interval, in half-widths."""
    half_width = max(0.5 * (interval.high - interval.low), np.finfo(float).tiny)
    return abs(interval.truth - 0.5 * (interval.low + interval.high)) / half_width


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


def foreign_fish(seed: int) -> Config:
    """Return a fish of one of `FOREIGN_KINDS`, and its rig."""
    register()
    kind = FOREIGN_KINDS[seed % len(FOREIGN_KINDS)]
    chance = random.Random(FIRST_SEED["foreign"] + seed)
    plain = msgspec.structs.asdict(PlantParameters())
    has_all = kind.startswith("all")
    ratio = chance.uniform(2.0, 4.0)
    varied = {
        name: plain[name] * chance.uniform(1 - SPREAD, 1 + SPREAD)
        for name in VARIED
        if name != "servo_lag"
    }
    imperfections = {
        "servo_asymmetry": (
            "asymmetry" in kind,
            chance.choice((-1, 1)) * chance.uniform(0.05, 0.2),
        ),
        "servo_dead_zone": ("dead zone" in kind, chance.uniform(0.01, 0.03)),
        "backlash": ("backlash" in kind, chance.uniform(0.01, 0.05)),
        "servo_delay": (kind == "delay", chance.uniform(0.005, 0.03)),
    }
    drag = chance.uniform(0.5, 2.0)
    ratios = {"K_y/K from 0.25 to 0.5": 1.0 / ratio}
    plant = ForeignParameters(
        model=MODEL,
        **varied,
        servo_law=kind if kind in LAWS else LAWS[(seed + seed // len(FOREIGN_KINDS)) % len(LAWS)],
        servo_lag=chance.uniform(0.05, 0.3),
        servo_acceleration=chance.uniform(60.0, 300.0),
        **{name: value for name, (is_on, value) in imperfections.items() if is_on or has_all},
        quadratic_drag=drag if kind == "quadratic drag" else 0.0,
        lateral_inertia_ratio=ratios.get(kind, ratio if "from 2 to 4" in kind else 1.0),
    )
    rig = SimulationSettings(
        noise=1e-3 * chance.uniform(0.5, 2.0),
        rotation=radians(chance.uniform(-5.0, 5.0)),
        offset_x=chance.uniform(-0.02, 0.02),
        offset_y=chance.uniform(-0.02, 0.02),
        drift=5e-3 * chance.random(),
        seed=FIRST_SEED["foreign"] + seed,
    )
    return Config(plant=plant, simulation=rig)


def true_values(config: Config, law: str) -> dict[str, Any]:
    """Return the true values of a fish and its rig, without those that the model does not have.

    law: law of the servo in the fit; only the same one has the same Δ
    """
    truth: dict[str, Any] = msgspec.structs.asdict(config.plant)
    truth |= msgspec.structs.asdict(config.simulation)
    if isinstance(config.plant, ForeignParameters):
        truth["backlash"] *= 0.5  # its whole width
        if law == "accelerating":
            truth["servo_lag"] = config.plant.servo_speed**2 / (2.0 * truth["servo_acceleration"])
    if law != truth["servo_law"]:
        del truth["servo_lag"]
    if truth["servo_law"] == "accelerating":  # it coasts through the zone to its middle
        del truth["servo_dead_zone"]
    return truth


def one(run: tuple[str, int]) -> Outcome:
    """Run one fish, and identify it."""
    kind, seed = run
    config = foreign_fish(seed) if kind == "foreign" else fish(kind, seed)
    with VirtualSession(config, EXACT) as swum:
        ticks = experiment(swum, SECONDS)
    begin = time.process_time()
    identification = identify(ticks, servo=swum.servo)
    took = time.process_time() - begin
    truth = true_values(config, identification.servo_law)
    truth["servo_delay"] += mean_wait(config)
    # Nearly three whole periods of the drift, so that its mean is almost zero.
    intervals = {
        each.name: Interval(
            truth[each.name], each.value, each.ci95_low, each.ci95_high, *each.narrowest_interval
        )
        for each in identification.estimates
        if each.fitted and each.name in truth
    }
    return Outcome(intervals, identification.headline.partition(":")[0], took)


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
    held = narrow = count = withheld = own = own_held = 0
    errors: list[float] = []
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
        f"{max(error for outcome in outcomes for error in outcome.errors):.2g}",
        str(
            sum(error > 2.0 for outcome in outcomes if outcome.trusted for error in outcome.errors)
        ),
    ]


def foreign_row(name: str, outcomes: Sequence[Outcome]) -> list[str]:
    """Return the row of some foreign fish."""
    errors = [error for outcome in outcomes for error in outcome.errors]
    held = sum(error <= HELD for error in errors)
    strict = [error for outcome in outcomes for error in outcome.strict_errors]
    strict_held = sum(error <= HELD for error in strict)
    verdicts = Counter(outcome.verdict for outcome in outcomes)
    far = [e for outcome in outcomes if outcome.trusted for e in outcome.errors if e > FAR]
    return [
        name,
        ", ".join(f"{count} {verdict}" for verdict, count in sorted(verdicts.items())),
        f"{held} of {len(errors)} ({held / max(1, len(errors)):.0%})",
        f"{strict_held} of {len(strict)} ({strict_held / max(1, len(strict)):.0%})",
        f"{max(errors, default=0.0):.2g}",
        str(len(far)),
        f"{np.median([outcome.seconds for outcome in outcomes]):.0f} s",
    ]


def report_foreign(outcomes: Sequence[Outcome]) -> Report:
    """Return the table of foreign fish, one of each of `FOREIGN_KINDS` in turn."""
    kinds = [
        foreign_row(kind, outcomes[place :: len(FOREIGN_KINDS)])
        for place, kind in enumerate(FOREIGN_KINDS[: len(outcomes)])
    ]
    verdicts = {
        verdict: [outcome for outcome in outcomes if outcome.verdict == verdict]
        for verdict in ("identified", "careful", "not identified")
    }
    verdicts = {verdict: fits for verdict, fits in verdicts.items() if fits}
    whole = [foreign_row(f"all, {verdict}", fits) for verdict, fits in verdicts.items()]
    errors = {
        f"identify, foreign fish, {verdict}": [error for fit in fits for error in fit.strict_errors]
        for verdict, fits in verdicts.items()
        if verdict != "not identified"
    }
    lines = table(FOREIGN_HEAD, [*kinds, *whole])
    figures = [outcome._asdict() for outcome in outcomes]
    return Report({"bench identification foreign": lines}, figures, errors=errors)


FOREIGN_HEAD = (
    "fish | first words | intervals that contain the true value | those that could miss | "
    "largest error, half-widths | "
    "errors above 2.5 half-widths, identified | median processor time of a fit"
)
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
    "--kind": {"choices": ("known", "foreign"), "default": "known", "help": "kinds of fish"},
    "--seeds": {
        "type": int,
        "help": "experiments of each kind, half as many harsh ones, default 10; or number of "
        "foreign fish, default 40",
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
    if options.kind == "foreign":
        runs = [("foreign", seed) for seed in range(options.seeds or FOREIGN_COUNT)]
        return report_foreign(run_cases(one, runs, options.jobs))
    sections, figures, whole, errors = {}, {}, [], []
    kinds = ["pi"] if options.on == "virtual-pi" else [kind for kind in KINDS if kind != "pi"]
    count = options.seeds or 10
    for kind in kinds:
        seeds = count if kind in EQUALLY_FITTED else (count + 1) // 2
        outcomes = run_cases(one, [(kind, seed) for seed in range(seeds)], options.jobs)
        whole.append(summary(kind, outcomes))
        figures[kind] = [outcome._asdict() for outcome in outcomes]
        errors += [error for outcome in outcomes for error in outcome.strict_errors]
        if kind in EQUALLY_FITTED:
            lines = rows(outcomes, known=kind != "outside")
            sections[f"bench identification {kind}"] = table(HEAD, lines)
    part = "virtual-pi" if kinds == ["pi"] else "summary"
    sections[f"bench identification {part}"] = table(SUMMARY, whole)
    where = "virtual Pi" if kinds == ["pi"] else "the model's fish"
    return Report(sections, figures, errors={f"identify, {where}": errors})
