"""What learning comes to: learning curves, policies on fish they never met, and speed.

Trainings are those of `fishctl learn ppo`, in a temporary folder. Efficiency is thrust over that of
the best square wave of the same fish and amplitude.

    efficiency   learning curves: several settings, ten seeds each; draws docs/learning-curves.png
    transfer     policies for one fish on sixteen others
    tank         tank time of trainings on a robot, evaluations included
    harsh        the policy that is shipped, and swing, on rigs that delay, play and react
    speed        environment and inference, on one core
"""

import statistics
import time
from argparse import Namespace
from collections.abc import Callable

import joblib
import numpy as np
from msgspec.structs import replace

from bench.learning_curves import learning_curves
from bench.policy import policy_file
from bench.tank_time import tank
from bench.trainings import Row, Trained, rig, settings_of, several
from common.report import DOCS, Options, Report, progress, spread, table
from fishd.config import Config, load
from fishd.controllers import registry
from fishd.lab.compare.contestants import best_on_grid, parse
from fishd.lab.compare.survey import survey
from fishd.lab.other_fish import CHANGES, harsh_fish
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.env.simulated_link import SimulatedLink
from fishd.learning.settings import TrainingSettings
from fishd.virtual.plant.optimum import best_square_wave

DOCUMENT = "learning.md"
FIGURE = DOCS / "learning-curves.png"
MILESTONES = (500, 1000, 2000, 5000, 8000, 20_000)
"""Control steps."""
ENOUGH, AT_END = 0.97, 0.99
SECONDS, SETTLE = 60.0, 10.0
STALLED = 0.5
"""A policy of less efficiency than this counts as stalled."""


def at(points: list[Evaluation], steps: int) -> int:
    """The policy that has learned from that many steps, or the newest from fewer."""
    return sum(point.steps <= steps for point in points) - 1


def efficiency(options: Namespace) -> str:
    """Learning curves of the settings that matter, and their figure."""
    plain = settings_of(None, MILESTONES[-1])
    blind = replace(plain, ppo=replace(plain.ppo, symmetric=False))
    rows = {
        "Φ = 0.42 rad": Row(rig(), plain),
        "Φ = 0.42 rad, without the mirror": Row(rig(), blind),
        "Φ = 0.42 rad, as in the paper": Row(
            rig(),
            settings_of("learning-paper.yaml", MILESTONES[-1]),
        ),
        "Φ = 0.2 rad": Row(rig(0.2), plain),
        "Φ = 0.8 rad": Row(rig(0.8), plain),
    }
    found = several(rows, range(options.seeds), options.jobs)
    picture = {
        row: [([p.steps for p in one.points], [p.efficiency for p in one.points]) for one in runs]
        for row, runs in found.items()
    }
    if options.write:
        learning_curves(FIGURE, picture, ENOUGH)
    heads = " | ".join(["", *(f"{steps} steps" for steps in MILESTONES)])
    learned, best, shape = [], [], []
    for row, runs in found.items():
        learned.append([row, *curve_of(runs, lambda one, k: one.points[k].efficiency)])
        best.append([row, *curve_of(runs, lambda one, k: one.best[k])])
        config = rows[row].config
        grid = best_on_grid(config)
        limit = grid.thrust / best_square_wave(config.plant, config.amplitude_limit).thrust
        ends = [one.points[-1] for one in runs]
        stalled = sum(end.efficiency < STALLED for end in ends)
        shape.append(
            [
                row,
                spread([end.fullness for end in ends], 1.0, 3),
                spread([end.frequency for end in ends], 1.0, 3),
                f"{grid.frequency:.3f}",
                f"{100.0 * limit:.1f}",
                f"{stalled} of {len(ends)}",
            ]
        )
    shape_heads = (
        "at the end | mean \\|φ_c\\|/Φ | frequency (Hz) | best on the grid (Hz) | "
        "its efficiency (%) | stalled"
    )
    return "\n\n".join(
        (
            f"Efficiency in %, median [lowest – highest] of {options.seeds} seeds, of the policy "
            "as it stands after so many control steps:",
            table(heads, learned),
            "And of the best that a seed has had until then, which is what is exported:",
            table(heads, best),
            "The commands that were learned:",
            table(shape_heads, shape),
        )
    )


def curve_of(runs: list[Trained], figure: Callable[[Trained, int], float]) -> list[str]:
    """The cells of a row: one for each milestone."""
    return [spread([figure(one, at(one.points, steps)) for one in runs]) for steps in MILESTONES]


def transfer(options: Namespace) -> str:
    """Policies of randomised and of plain trainings, on fish that they have never met."""
    several_fish = settings_of("learning-transfer.yaml")
    rows = {
        "`learning-transfer.yaml`, best": Row(rig(), several_fish),
        "default settings, best": Row(rig(), settings_of(None, 8000)),
    }
    found = several(rows, range(options.seeds), options.jobs, others=True)
    lines = []
    for row, runs in found.items():
        for label, off in (
            (row, [one.others for one in runs]),
            (row.replace("best", "last"), [one.others_last for one in runs]),
        ):
            lines.append(
                [
                    label,
                    spread([min(values) for values in off]),
                    spread([statistics.median(values) for values in off]),
                    f"{sum(min(values) >= 0.93 for values in off)} of {len(off)}",
                ]
            )
    heads = "policy | worst of 16 fish | median of 16 fish | seeds with all ≥ 93 %"
    of_seeds = f"Efficiency in %, median [lowest – highest] of {options.seeds} seeds:"
    return f"{of_seeds}\n\n{table(heads, lines)}"


def harsh(options: Namespace) -> str:
    """What `fishctl learn evaluate --fish harsh` shows, for three contestants."""
    changes, random = list(CHANGES), list(harsh_fish())
    configs = [(fish, load(None, fish.overrides)) for fish in (*changes, *random)]
    contestants = [parse(text) for text in ("default-fish", "swing:C=0.6", "swing:C=auto")]
    found = survey(configs, contestants, SECONDS, SETTLE)
    rows = [
        [fish.name, *(f"{100 * one.fish[row].efficiency:.1f}" for one in found)]
        for row, fish in enumerate(changes)
    ]
    others = [one.fish[len(changes) :] for one in found]
    for name, pick in (("median", statistics.median), ("worst", min)):
        figures = [pick(swum.efficiency for swum in row) for row in others]
        rows.append(
            [f"{len(random)} harsh fish, {name}", *(f"{100 * share:.1f}" for share in figures)]
        )
    lost = [sum(swum.fallback is not None for swum in one.fish) for one in found]
    rows.append(["another took over, runs", *map(str, lost)])
    shaken = [max(swum.shaken for swum in one.fish) for one in found]
    rows.append(["reversals in consecutive ticks, at most, s", *(f"{s:.1f}" for s in shaken)])
    heads = " | ".join(["fish", *(f"`{one.contestant}`" for one in found)])
    return f"Efficiency in %, of a minute whose first 10 s do not count:\n\n{table(heads, rows)}"


def speed(options: Namespace) -> str:
    """Steps of the environment per second, and time of an inference, on one core."""
    config = rig()
    lines = []
    for name, file in (
        ("default settings", None),
        ("`learning-harsh.yaml`", "learning-harsh.yaml"),
    ):
        lines.append(f"- environment, {name}, {steps_per_second(config, settings_of(file))}")
    return "\n".join((*lines, f"- {inference(config)}"))


def steps_per_second(config: Config, settings: TrainingSettings) -> str:
    """Of the environment with random actions, on one core; always the configured fish."""
    env = SwimEnv(SimulatedLink(config), config, settings.environment)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (10_000, 1)).astype(np.float32)
    rates = []
    for _ in range(5):
        begun = time.perf_counter()
        for action in actions:
            if env.step(action)[3]:
                env.reset()
        rates.append(len(actions) / (time.perf_counter() - begun))
    return (
        f"full loop in process, one core: {max(rates):.0f} steps/s "
        f"(best of five times {len(actions)} steps; slowest {min(rates):.0f})"
    )


def inference(config: Config) -> str:
    """Time of the controller `ppo` in the tick, with a network of the default size."""
    with policy_file(None) as file:
        controller = registry.create("ppo", {"policy": file}, config.limits)
    observation = SimulatedLink(config).reset()
    times = []
    for _ in range(20_000):
        begun = time.perf_counter()
        controller.update(observation)
        times.append(1e6 * (time.perf_counter() - begun))
    median, tail = np.percentile(times, (50, 99))
    return f"the controller `ppo`, observation to angle: {median:.1f} µs, p99 {tail:.1f} µs"


PARTS = {
    "efficiency": efficiency,
    "transfer": transfer,
    "tank": tank,
    "harsh": harsh,
    "speed": speed,
}


OPTIONS: Options = {
    "part": {"choices": (*PARTS, "all")},
    "--seeds": {"type": int, "default": 10, "help": "trainings of each row; default 10"},
    "--jobs": {
        "type": int,
        "default": max(1, joblib.cpu_count() - 1),
        "help": "processes; default: one per core, less one",
    },
}


def measure(options: Namespace) -> Report:
    """The parts that are asked for."""
    sections = {}
    for part in PARTS if options.part == "all" else (options.part,):
        begun = time.perf_counter()
        sections[f"bench learning {part}"] = PARTS[part](options)
        progress(part, f"{time.perf_counter() - begun:.0f} s")
    return Report(sections, sections)
