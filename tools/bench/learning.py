"""Measures what learning comes to, and writes it into docs/learning.md.

    python tools/bench_learning.py efficiency   learning curves: several settings, ten seeds each
    python tools/bench_learning.py transfer     policies for one fish on sixteen others
    python tools/bench_learning.py speed        environment and inference, on one core
    python tools/bench_learning.py all

Trainings are those of `fishctl learn ppo`, in a temporary folder. Efficiency is thrust over that of
the best square wave of the same fish and amplitude.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import joblib
import numpy as np
from learning_trials import Trained, rig, settings_of, several
from msgspec.structs import replace
from reports import put, table

from fishd.config import Config
from fishd.controllers import registry
from fishd.learning.environment import SwimEnv
from fishd.learning.evaluation import best_on_grid
from fishd.learning.figures import learning_curves
from fishd.learning.in_process import InProcess
from fishd.learning.ppo import layers_of, make_policy
from fishd.learning.provenance import make_card
from fishd.learning.scales import features
from fishd.learning.seed_table import Point
from fishd.learning.settings import TrainingSettings
from fishd.plant.optimum import best_square_wave
from fishd.policies.network import to_onnx

ROOT = Path(__file__).resolve().parent.parent
DOCUMENT = ROOT / "docs" / "learning.md"
FIGURE = ROOT / "docs" / "learning-curves.png"
MILESTONES = (1000, 2000, 3000, 5000, 8000, 20_000)
"""Control steps."""
ENOUGH, AT_END = 0.97, 0.99
STALLED = 0.5
"""A policy of less efficiency than this counts as stalled."""


def at(points: list[Point], steps: int) -> Point:
    """The policy that has learned from that many steps, or the newest from fewer."""
    return [point for point in points if point.steps <= steps][-1]


def spread(values: Sequence[float], factor: float = 100.0, digits: int = 1) -> str:
    """Median, and range in brackets."""
    middle, low, high = (
        f"{factor * function(values):.{digits}f}" for function in (statistics.median, min, max)
    )
    return f"{middle} [{low} – {high}]"


def efficiency(seeds: int, jobs: int) -> str:
    """Learning curves of the settings that matter, and their figure."""
    plain = settings_of(None, MILESTONES[-1])
    blind = replace(plain, ppo=replace(plain.ppo, symmetric=False))
    rows = {
        "Φ = 0.42 rad": (rig(), plain),
        "Φ = 0.42 rad, without the mirror": (rig(), blind),
        "Φ = 0.42 rad, as in the paper": (
            rig(),
            settings_of("learning-paper.yaml", MILESTONES[-1]),
        ),
        "Φ = 0.2 rad": (rig(0.2), plain),
        "Φ = 0.8 rad": (rig(0.8), plain),
    }
    found = several(rows, seeds, jobs)
    picture = {
        row: [([p.steps for p in one.points], [p.efficiency for p in one.points]) for one in runs]
        for row, runs in found.items()
    }
    learning_curves(FIGURE, picture, ENOUGH)
    heads = [f"{steps} steps" for steps in MILESTONES]
    learned, best, shape = [], [], []
    for row, runs in found.items():
        learned.append([row, *curve_of(runs, lambda point: point.efficiency)])
        best.append([row, *curve_of(runs, lambda point: point.best)])
        config = rows[row][0]
        grid = best_on_grid(config)
        limit = grid.thrust / best_square_wave(config.plant, config.amplitude_limit).thrust
        ends = [one.points[-1] for one in runs]
        stalled = sum(point.efficiency < STALLED for point in ends)
        shape.append(
            [
                row,
                spread([point.fullness for point in ends], 1.0, 3),
                spread([point.frequency for point in ends], 1.0, 3),
                f"{grid.frequency:.3f}",
                f"{100.0 * limit:.1f}",
                f"{stalled} of {len(ends)}",
            ]
        )
    shape_heads = [
        "at the end",
        "mean \\|φ_c\\|/Φ",
        "frequency (Hz)",
        "best on the grid (Hz)",
        "its efficiency (%)",
        "stalled",
    ]
    return "\n\n".join(
        (
            f"Efficiency in %, median [lowest – highest] of {seeds} seeds, of the policy as it "
            "stands after so many control steps:",
            table(["", *heads], learned),
            "And of the best that a seed has had until then, which is what is exported:",
            table(["", *heads], best),
            "The commands that were learned:",
            table(shape_heads, shape),
        )
    )


def curve_of(runs: list[Trained], figure: Callable[[Point], float]) -> list[str]:
    """The cells of a row: one for each milestone."""
    return [spread([figure(at(one.points, steps)) for one in runs]) for steps in MILESTONES]


def transfer(seeds: int, jobs: int) -> str:
    """Policies of randomised and of plain trainings, on fish that they have never met."""
    several_fish = settings_of("learning-transfer.yaml")
    rows = {
        "`learning-transfer.yaml`, best": (rig(), several_fish),
        "default settings, best": (rig(), settings_of(None, 8000)),
    }
    found = several(rows, seeds, jobs, others=True)
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
    heads = ["policy", "worst of 16 fish", "median of 16 fish", "seeds with all ≥ 93 %"]
    return f"Efficiency in %, median [lowest – highest] of {seeds} seeds:\n\n{table(heads, lines)}"


def speed(seeds: int, jobs: int) -> str:
    """Steps of the environment per second, and time of an inference, on one core."""
    config, settings = rig(), TrainingSettings()
    env = SwimEnv(InProcess(config), config, settings.environment)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (10_000, 1)).astype(np.float32)
    rates = []
    for _ in range(5):
        begun = time.perf_counter()
        for action in actions:
            if env.step(action)[3]:
                env.reset()
        rates.append(len(actions) / (time.perf_counter() - begun))
    return "\n".join(
        (
            f"- environment, full loop in process, one core: {max(rates):.0f} steps/s "
            f"(best of five times {len(actions)} steps; slowest {min(rates):.0f})",
            f"- {inference(config, settings)}",
        )
    )


def inference(config: Config, settings: TrainingSettings) -> str:
    """Time of the controller `ppo` in the tick, with a network of the default size."""
    seen = features(config, settings.environment)
    layers = layers_of(make_policy(settings.ppo, len(seen)))
    card = make_card(config, settings, seen, "simulation", 0, None, "")
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary) / "untrained.onnx"
        file.write_bytes(to_onnx(layers, settings.ppo.activation, card))
        controller = registry.create("ppo", {"policy": str(file)}, config.limits)
    observation = InProcess(config).start()
    times = []
    for _ in range(20_000):
        begun = time.perf_counter()
        controller.update(observation)
        times.append(1e6 * (time.perf_counter() - begun))
    median, tail = np.percentile(times, (50, 99))
    return f"the controller `ppo`, observation to angle: {median:.1f} µs, p99 {tail:.1f} µs"


PARTS = {"efficiency": efficiency, "transfer": transfer, "speed": speed}


def main() -> None:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("part", choices=(*PARTS, "all"))
    parser.add_argument("--seeds", type=int, default=10, help="trainings of each row; default 10")
    parser.add_argument(
        "--jobs",
        type=int,
        default=max(1, joblib.cpu_count() - 1),
        help="processes; default: one per core, less one",
    )
    parser.add_argument("--no-write", action="store_true", help="leave docs/ as it is")
    options = parser.parse_args()
    for part in PARTS if options.part == "all" else (options.part,):
        begun = time.perf_counter()
        text = PARTS[part](options.seeds, options.jobs)
        print(f"{text}\n({time.perf_counter() - begun:.0f} s)", flush=True)
        if not options.no_write:
            put(DOCUMENT, f"learning-{part}", text)


if __name__ == "__main__":
    main()
