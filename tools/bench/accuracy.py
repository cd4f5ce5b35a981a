"""How often the 95 % intervals of fishd contain the truth, on simulated fish.

    measure    `fishctl measure swing`, a minute, under drifts of the force sensor
    shown      the thrust that is shown while `swing` swims, under the same drifts
    optimise   `fishctl optimise` over C and over a frequency, on random fish
    identify   three minutes of excitation of random fish, also behind the drivers of a virtual Pi
    foreign    the same with fish of another program, whose servos follow other laws
    adapt      `fishctl adapt` on fish with all imperfections of a real rig
    adapt-foreign   the same with fish of another program

Nothing was chosen with these fish and seeds. Each result keeps its errors, in half-widths of its
interval, in docs/figures/accuracy.csv with --write; the table and the figure are of all of them.
`--fish 0 --write` only makes these again.
"""

import csv
import json
import random
from argparse import Namespace
from collections.abc import Callable, Mapping
from functools import partial
from math import isfinite, radians
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

from bench.foreign_fish import ForeignParameters, foreign_fish, register
from common.in_process import fishctl
from common.report import DOCS, JOBS, Options, Report, progress, run_cases, table
from fishd.config import Config, load, to_yaml
from fishd.core.calibration import EXACT
from fishd.lab.compare.survey import harsh, mild
from fishd.lab.drawing import BLACK, open_figure, plain
from fishd.lab.identification import experiment, identify
from fishd.lab.identification.summary import SCALED
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import simulate
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.pulse_train import SERVO_FRAME
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.tank import STEP
from fishd.virtual.plant.parameters import PlantParameters

ERRORS = DOCS / "figures" / "accuracy.csv"
MAX_SHOWN = 3.0
"""Largest error on the axis of the figure [half-widths]."""
DRIFTS: dict[str, dict[str, float]] = {
    "no drift": {},
    "sine of 5 mN, 60 s": {"drift": 5e-3},
    "sine of 5 mN, 20 s": {"drift": 5e-3, "drift_period": 20.0},
    "walk of 0.5 mN/√s": {"drift_walk": 5e-4},
    "line of 0.2 mN/s": {"drift_rate": 2e-4},
}
GROUPS = {"measure": "five drifts", "shown thrust": "five drifts", "optimise": "three searches"}
"""Results of several kinds that share a row of the table, and the name of that row."""
REST_S, SKIPPED_S, SHOWN_S = 3.0, 30.0, 240.0
"""Rest before the thrust is shown, start that does not count, and length of the swim [s]."""
VARIED = (
    "omega0", "xi", "coupling", "servo_speed", "servo_lag", "thrust_coefficient", "lateral_drag",
)  # fmt: skip
"""Parameters of a random fish, up to 30 % from the default one."""
MAX_DRAG, MAX_LATERAL_DRAG = 2.0, 0.01
"""Largest quadratic drag of the fin [1/rad], and in F_y [N s²/rad²]."""
RATIOS = (0.6, 0.85), (1.15, 1.6)
"""Ranges of K_y/K of a fish outside the usual model."""
SECONDS = 180.0
"""Length of the experiment for `identify` [s]."""
FIRST_SEED = {
    "measure": 31_000, "shown": 7500, "optimise": 93_000, "other": 51_000, "outside": 52_000,
    "harsh": 900, "pi": 54_000, "foreign": 53_000, "adapt": 950, "adapt-foreign": 8000,
}  # fmt: skip
Errors = list[tuple[str, float]]
"""Kinds of result and their errors, in half-widths of the 95 % interval."""


def run_verb(words: str, config: Config) -> dict[str, Any]:
    """Return what a verb of fishctl prints as JSON about a fish in virtual time."""
    register()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "fish.yaml"
        file.write_text(to_yaml(config), encoding="utf-8")
        done = fishctl(
            *words.format(folder=folder).split(),
            *("--on", "simulation", "--config", str(file), "--json"),
        )
    if done.returncode:
        raise RuntimeError(f"fishctl {words}: {done.stderr}")
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def judge(kind: str, result: Mapping[str, Any], truth: float) -> tuple[str, float]:
    """Return the error of a thrust [half-widths of its total interval]."""
    half_width = result.get("total_ci95") or result["thrust_ci95"]
    return kind, (result["thrust"] - truth) / half_width


def drifting(drift: str, seed: int) -> Config:
    """Return the default fish on a noisy sensor that drifts."""
    rig = SimulationSettings(noise=1e-3, offset_y=0.01, rotation=0.05, seed=seed, **DRIFTS[drift])  # type: ignore[arg-type]
    return Config(simulation=rig)


def measure_drifts(seed: int) -> Errors:
    """Measure under each drift."""
    truth = simulate(Config(), "swing", {}).mean_thrust
    return [
        judge(
            f"measure, {drift}",
            run_verb("measure swing --seconds 60", drifting(drift, seed)),
            truth,
        )
        for drift in DRIFTS
    ]


def show_thrusts(seed: int) -> Errors:
    """Swim after one rest under each drift, and judge the thrust that is shown every minute."""
    truth = simulate(Config(), "swing", {}).mean_thrust
    errors = []
    for drift in DRIFTS:
        with VirtualSession(drifting(drift, seed)) as session:
            session.rest(REST_S)
            ticks = session.swim("swing", {}, SHOWN_S)
        shown = ticks[round(SKIPPED_S / session.tick) :: round(60.0 / session.tick)]
        errors += [
            (f"shown thrust, {drift}", (tick.thrust - truth) / tick.thrust_ci95)
            for tick in shown
            if isinstance(tick.thrust_ci95, float)
        ]
    return errors


def optimise(seed: int) -> Errors:
    """Search C of `swing`, and the frequency of a square wave; also with a strong drift."""
    errors = []
    for what, words, noise, drift in (
        ("C, 1 mN", "swing --C 0:1", 1e-3, 0.0),
        ("frequency, 1 mN", "square --frequency 0.4:5", 1e-3, 0.0),
        ("frequency, 3 mN, drift", "square --frequency 0.4:5", 3e-3, 0.02),
    ):
        rig = SimulationSettings(noise=noise, drift=drift, seed=seed)
        config = msgspec.structs.replace(load(None, mild(seed).overrides), simulation=rig)
        result = run_verb(f"optimise {words} --seed {seed} --folder {{folder}}/run", config)
        progress(f"{what}, fish {seed}", f"{result['relative_thrust']:.1%} of the best square wave")
        errors.append(judge(f"optimise, {what}", result, result["true_thrust"]))
    return errors


def adapt(kind: str, seed: int) -> Errors:
    """Adapt to a fish, and judge the thrusts of the gaits."""
    fish = load(None, harsh(seed).overrides) if kind == "harsh" else foreign_fish(seed)
    result = run_verb("adapt --folder {folder}/run", fish)
    progress(f"fish {seed}", result["verdict"]["claim"])
    return [
        judge(f"adapt, {kind} fish", gait, gait["true_thrust"]) for gait in result["contenders"]
    ]


def random_fish(kind: str, seed: int) -> Config:
    """Return a fish and its rig: `other`, `outside` the usual model, `harsh`, or on a `pi`."""
    if kind == "harsh":
        return load(None, harsh(seed).overrides)
    rig = SimulationSettings(
        noise=1e-3, rotation=radians(5), offset_x=0.02, offset_y=0.02, drift=5e-3, seed=seed
    )
    chance = random.Random(seed)
    plant = PlantParameters()
    varied = {name: getattr(plant, name) * chance.uniform(0.7, 1.3) for name in VARIED}
    varied["servo_delay"] = chance.uniform(0.0, 0.03 if kind == "pi" else 0.1)
    varied["backlash"] = chance.uniform(0.0, 0.05)
    if kind == "outside":
        varied["quadratic_drag"] = chance.uniform(0.0, MAX_DRAG)
        varied["lateral_quadratic_drag"] = chance.uniform(0.0, MAX_LATERAL_DRAG)
        varied["lateral_inertia_ratio"] = chance.uniform(*chance.choice(RATIOS))
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


def true_values(config: Config, law: str) -> dict[str, Any]:
    """Return the true values of a fish and its rig, without those that the model does not have.

    law: law of the servo in the fit; only the same one has the same Δ
    """
    truth: dict[str, Any] = msgspec.structs.asdict(config.plant)
    truth |= msgspec.structs.asdict(config.simulation)
    truth["servo_delay"] += mean_wait(config)
    if isinstance(config.plant, ForeignParameters):
        truth["backlash"] *= 0.5  # its whole width
        if law == "accelerating":
            truth["servo_lag"] = config.plant.servo_speed**2 / (2.0 * truth["servo_acceleration"])
    if law != truth["servo_law"]:
        del truth["servo_lag"]
    if truth["servo_law"] == "accelerating":  # it coasts through the zone to its middle
        del truth["servo_dead_zone"]
    return truth


def identify_fish(kind: str, seed: int) -> Errors:
    """Identify a fish, beginning with the default one.

    Intervals that can hardly miss are left out: for the assumed range of K_y/K, of parameters that
    are truly zero, which is the end of their interval, and those that are withheld.
    """
    config = foreign_fish(seed) if kind == "foreign" else random_fish(kind, seed)
    with VirtualSession(config, EXACT) as session:
        ticks = experiment(session, SECONDS)
    fit = identify(ticks, servo=session.servo)
    verdict = fit.headline.partition(":")[0]
    name = {"foreign": f"foreign fish, {verdict}", "pi": "virtual Pi"}.get(kind, "the model's fish")
    truth, errors = true_values(config, fit.servo_law), []
    for each in fit.estimates:
        is_judged = each.fitted and each.name in truth and each.name not in SCALED
        if not is_judged or not isfinite(each.ci95_high):
            continue
        if truth[each.name] == 0.0 == each.ci95_low or verdict == "not identified":
            continue
        half_width = max(0.5 * (each.ci95_high - each.ci95_low), np.finfo(float).tiny)
        middle = 0.5 * (each.ci95_high + each.ci95_low)
        errors.append((f"identify, {name}", (truth[each.name] - middle) / half_width))
    progress(f"{kind} fish {seed}", fit.headline)
    return errors


PARTS: dict[str, dict[str, Callable[[int], Errors]]] = {
    "measure": {"measure": measure_drifts},
    "shown": {"shown": show_thrusts},
    "optimise": {"optimise": optimise},
    "identify": {
        kind: partial(identify_fish, kind) for kind in ("other", "outside", "harsh", "pi")
    },
    "foreign": {"foreign": partial(identify_fish, "foreign")},
    "adapt": {"adapt": partial(adapt, "harsh")},
    "adapt-foreign": {"adapt-foreign": partial(adapt, "foreign")},
}
"""Functions that return the errors of a fish, by the name of their first seed, for each part."""


def one(case: tuple[str, str, int]) -> Errors:
    """Judge one fish; case: part, name of the first seed, number of the fish."""
    part, name, number = case
    return PARTS[part][name](FIRST_SEED[name] + number)


OPTIONS: Options = {
    "--only": {"nargs": "+", "choices": [*PARTS], "default": [*PARTS], "help": "parts"},
    "--fish": {"type": int, "default": 10, "help": "number of fish or seeds of each kind"},
    **JOBS,
}


def measure(options: Namespace) -> Report:
    """Judge every part, and return the table of these and of the stored errors."""
    cases = [
        (part, name, number)
        for part in options.only
        for name in PARTS[part]
        for number in range(options.fish)
    ]
    fresh: dict[str, list[float]] = {}
    for kind, error in (pair for pairs in run_cases(one, cases, options.jobs) for pair in pairs):
        fresh.setdefault(kind, []).append(error)
    stored: dict[str, list[float]] = {}
    for line in ERRORS.read_text(encoding="utf-8").splitlines():
        kind, _, error = line.rpartition(",")
        stored.setdefault(kind.strip('"'), []).append(float(error))
    errors = stored | fresh
    if options.write:
        with ERRORS.open("w", encoding="utf-8", newline="") as file:
            rows = ((kind, f"{error:.3f}") for kind, values in errors.items() for error in values)
            csv.writer(file, lineterminator="\n").writerows(rows)
        draw(errors)
    head = "result | intervals | contain the truth | within 2 half-widths | largest error"
    return Report({"bench accuracy": table(head, table_rows(errors))}, errors)


def table_rows(errors: Mapping[str, list[float]]) -> list[list[str]]:
    """Return a row for each result; kinds in `GROUPS` share one, which names the worst of them."""
    groups: dict[str, dict[str, list[float]]] = {}
    for kind, values in errors.items():
        result, _, case = kind.partition(", ")
        name = f"{result}, {GROUPS[result]}" if result in GROUPS else kind
        groups.setdefault(name, {})[case] = values
    rows = []
    for name, cases in groups.items():
        sizes = np.abs(np.concatenate([*cases.values()]))
        worst = max(cases, key=lambda case: np.max(np.abs(cases[case])))
        rows.append(
            [
                name,
                str(len(sizes)),
                f"{np.mean(sizes <= 1.0):.1%}",
                f"{np.mean(sizes <= 2.0):.1%}",
                f"{np.max(sizes):.1f}" + (f" ({worst})" if len(cases) > 1 else ""),
            ]
        )
    return rows


def draw(errors: dict[str, list[float]]) -> None:
    """Draw the share of the errors of `identify` up to each size, beside a normal distribution."""
    from scipy.stats import norm

    with open_figure(ERRORS.with_suffix(".svg"), (7.0, 4.2)) as figure:
        axis = figure.subplots()
        sizes = np.linspace(0.0, MAX_SHOWN, 301)
        ideal = 2.0 * norm.cdf(norm.ppf(0.975) * sizes) - 1.0
        axis.plot(sizes, 100.0 * ideal, color=BLACK, linestyle="--", label="normal distribution")
        for kind, values in errors.items():
            if kind.startswith("identify"):
                ordered = np.sort(np.abs(values))
                shares = np.searchsorted(ordered, sizes, side="right") / len(ordered)
                axis.plot(sizes, 100.0 * shares, linewidth=1.2, label=plain(kind))
        axis.axvline(1.0, color=BLACK, linewidth=0.5)
        axis.axhline(95.0, color=BLACK, linewidth=0.5)
        axis.set_xlim(0.0, MAX_SHOWN)
        axis.set_ylim(0.0, 101.0)
        axis.set_xlabel("error, in half-widths of its 95 % interval")
        axis.set_ylabel("share of the results (%)")
        axis.legend(fontsize="small", loc="lower right")
