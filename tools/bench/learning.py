"""Results of learning: learning curves, policies on unknown fish, and speed.

Trainings are those of `fishctl learn ppo`, in a temporary folder, with seeds that no setting was
chosen with. Relative thrust is the thrust over that of the best square wave of the same fish.

    curves     several fish and settings, from forces; draws learning-curves.png
    pictures   several feature extractors and cameras; draws camera-learning.png
    transfer   policies for one fish on sixteen others
    unknown    a shipped policy, policies for one fish, and `swing`, on 80 fish of each kind
    speed      steps of the environment, and inference, on one core
"""

import itertools
import math
import statistics
import tempfile
import time
from argparse import ArgumentTypeError, Namespace
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import joblib
import numpy as np
from msgspec.structs import replace

from bench.learning_curves import learning_curves
from common.report import (
    DOCS,
    Options,
    Report,
    percent,
    progress,
    quantile,
    run_cases,
    spread,
    table,
)
from fishd.camera.simulated import DEFAULT, WEB, SimulatedCameraSettings
from fishd.config import Config, load
from fishd.controllers import registry
from fishd.lab.compare.contestants import Contestant, best_on_grid, parse
from fishd.lab.compare.survey import FishResult, OtherFish, harsh, mild, survey
from fishd.lab.simulation import simulate
from fishd.learning import settings as training
from fishd.learning.env.environment import SwimEnv, best_thrust
from fishd.learning.env.evaluation import Evaluation, judge
from fishd.learning.export import export
from fishd.learning.extractors import make_extractor
from fishd.learning.links.simulated_link import Camera, SimulatedLink
from fishd.learning.ppo import DeterministicPolicy
from fishd.learning.run_folder.checkpoints import load_policy
from fishd.learning.run_folder.tables import best_so_far, read_evaluations
from fishd.learning.settings import TrainingSettings
from fishd.learning.train.jobs import Job
from fishd.learning.train.training import train

CONFIG = DOCS.parent / "config"
SEEDS, PICTURE_SEEDS = range(240, 250), range(230, 240)
"""Seeds of the trainings from forces and from pictures."""
PAPER_STEPS, PICTURE_STEPS, PAPER_PICTURE_STEPS = 20_000, 4096, 15_360
"""Control steps of trainings whose length is not the default one."""
MIN_STEPS = 512
"""Number of control steps after which also a training with pictures has an evaluation."""
NEARLY, GOOD = 0.95, 0.97
"""Relative thrusts that every fish, and a training, should reach."""
PARAMETER_CHANGE = 0.15
"""Relative change of each of four parameters of a fish, up or down."""
UNKNOWN_FISH = {
    "mild": [mild(seed) for seed in range(70_000, 70_080)],
    "harsh": [harsh(seed) for seed in range(71_000, 71_080)],
}
"""Fish of the part `unknown`; nothing was chosen with them."""
SECONDS, SETTLE = 60.0, 10.0
"""Length of an evaluation on other fish, and of its ignored start [s]."""


class Row(NamedTuple):
    """Training with several seeds."""

    config: Config
    settings: TrainingSettings
    camera: SimulatedCameraSettings = SimulatedCameraSettings()
    """Camera, where the settings require pictures."""


class Trained(NamedTuple):
    """Result of one training."""

    points: list[Evaluation]
    best: list[float]
    """Relative thrust of the best policy up to each step."""
    others: list[float]
    """Relative thrusts of its best policy on changed fish, if requested."""
    cost: float
    """Processor time for 1000 steps, including evaluations [s]."""

    def steps_to(self, relative_thrust: float) -> float:
        """Return the steps until the first evaluation with that relative thrust; inf without."""
        reached = zip(self.points, self.best, strict=True)
        return next((point.steps for point, best in reached if best >= relative_thrust), math.inf)


def rig(amplitude: float = 0.42) -> Config:
    """Return a fish with 1 mN of noise and an offset of 5 mN on F_y."""
    keys = ("simulation.noise=0.001", "simulation.offset_y=0.005")
    return load(None, [f"amplitude_limit={amplitude}", *keys])


def settings_of(name: str | None = None, steps: int | None = None) -> TrainingSettings:
    """Return the settings in a file of config/, or the defaults, with another number of steps.

    A training runs all steps, so that learning curves can be compared.
    """
    chosen = training.load(CONFIG / name if name else None)
    evaluation = replace(chosen.evaluation, patience=None)
    return replace(chosen, steps=steps or chosen.steps, evaluation=evaluation)


def without_symmetry(settings: TrainingSettings) -> TrainingSettings:
    """Return the settings of a policy that does not know that left and right are alike."""
    return replace(settings, ppo=replace(settings.ppo, symmetric=False))


def trained(row: Row, seed: int, others: bool) -> Trained:
    """Train once, in a separate process."""
    fish = replace(row.config, simulation=replace(row.config.simulation, seed=seed))
    with tempfile.TemporaryDirectory() as temporary:
        job = Job(
            config=fish,
            settings=replace(row.settings, seed=seed),
            folder=Path(temporary) / "run",
            camera=replace(row.camera, seed=seed),
        )
        start = time.process_time()
        outcome = train(job)
        seconds = time.process_time() - start
        points = read_evaluations(job.folder)
        shares = swim_others(outcome.best, row.config) if others and outcome.best else []
        return Trained(points, best_so_far(points), shares, 1000.0 * seconds / outcome.steps)


def swim_others(checkpoint: Path, config: Config) -> list[float]:
    """Return the relative thrust of a policy on each changed fish."""
    shares = []
    for changed in changed_fish(config):
        decide = DeterministicPolicy(*load_policy(checkpoint), config.amplitude_limit)
        shares.append(judge(changed, decide, SECONDS, SETTLE).relative_thrust)
    return shares


def changed_fish(config: Config) -> Iterator[Config]:
    """Return sixteen fish with each of four parameters changed up or down."""
    plant = config.plant
    values = (plant.omega0, plant.xi, plant.servo_speed, plant.coupling)
    for signs in itertools.product((-1.0, 1.0), repeat=4):
        omega0, xi, speed, coupling = (
            value * (1.0 + PARAMETER_CHANGE * sign)
            for value, sign in zip(values, signs, strict=True)
        )
        changed = replace(plant, omega0=omega0, xi=xi, servo_speed=speed, coupling=coupling)
        yield replace(config, plant=changed, simulation=replace(config.simulation, seed=1000))


def train_all(
    rows: Mapping[str, Row], seeds: Sequence[int], options: Namespace, others: bool = False
) -> dict[str, list[Trained]]:
    """Train all seeds of all rows in parallel."""
    if options.steps:
        rows = {
            name: row._replace(settings=replace(row.settings, steps=options.steps))
            for name, row in rows.items()
        }
    tasks = [(row, seed) for row in rows for seed in seeds]
    trainings: dict[str, list[Trained]] = {row: [] for row in rows}
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=options.jobs, batch_size=1, return_as="generator")
        work = parallel(joblib.delayed(trained)(rows[row], seed, others) for row, seed in tasks)
        for (row, seed), result in zip(tasks, work, strict=True):
            trainings[row].append(result)
            last = result.points[-1]
            progress(f"{row}, seed {seed}: {last.relative_thrust:.1%}, best {result.best[-1]:.1%}")
    return trainings


def curves(options: Namespace) -> Report:
    """Train the default settings on several fish, and two other settings."""
    plain, paper = settings_of(), settings_of("learning-paper.yaml", PAPER_STEPS)
    rows = {
        "Φ = 0.42 rad": Row(rig(), plain),
        "Φ = 0.2 rad": Row(rig(0.2), plain),
        "Φ = 0.8 rad": Row(rig(0.8), plain),
        "`config/simulated.yaml`": Row(load(CONFIG / "simulated.yaml"), plain),
        "`config/harsh.yaml`": Row(load(CONFIG / "harsh.yaml"), plain),
        "Φ = 0.42 rad, without symmetry": Row(rig(), without_symmetry(plain)),
        "Φ = 0.42 rad, as in the paper": Row(rig(), paper),
    }
    trainings = train_all(rows, SEEDS[: options.seeds], options)
    shown = [row for row in rows if "simulated" not in row]
    draw(options, "learning-curves.png", trainings, shown)
    return Report({"bench learning relative_thrust": summary(rows, trainings)}, None)


def pictures(options: Namespace) -> Report:
    """Train each feature extractor with each camera, and from forces."""
    modes = replace(settings_of(None, PICTURE_STEPS), see="camera")
    cnn = settings_of("learning-cnn.yaml", PICTURE_STEPS)
    paper = settings_of("learning-camera-paper.yaml", PAPER_PICTURE_STEPS)
    rows = {
        "`modes`, rig default": Row(rig(), modes),
        "`modes`, rig web": Row(rig(), modes, WEB),
        "`cnn`, rig default": Row(rig(), cnn),
        "`cnn`, rig web": Row(rig(), cnn, WEB),
        "`cnn`, default, without symmetry": Row(rig(), without_symmetry(cnn)),
        "force": Row(rig(), settings_of(None, PICTURE_STEPS)),
    }
    trainings = train_all(rows, PICTURE_SEEDS[: options.seeds], options)
    slow = {"as in the paper": Row(rig(), paper)}
    trainings |= train_all(slow, PICTURE_SEEDS[: few(options)], options)
    shown = ("`modes`, rig default", "`cnn`, rig default", "as in the paper", "force")
    draw(options, "camera-learning.png", trainings, shown)
    return Report({"bench pictures steps": summary(rows | slow, trainings)}, None)


def few(options: Namespace) -> int:
    """Return the number of seeds of slow trainings."""
    return max(1, round(0.3 * options.seeds))


def draw(
    options: Namespace, name: str, trainings: Mapping[str, list[Trained]], shown: Sequence[str]
) -> None:
    """Draw the learning curves of some trainings into docs/figures/, for --write."""
    if options.write:
        drawn = {
            row.replace("`", ""): [
                ([point.steps for point in run.points], run.best) for run in trainings[row]
            ]
            for row in shown
        }
        learning_curves(DOCS / "figures" / name, drawn, GOOD)


def summary(rows: Mapping[str, Row], trainings: Mapping[str, list[Trained]]) -> str:
    """Return a table of the steps to a good policy, and of the best policies."""
    lines = []
    for name, runs in trainings.items():
        config = rows[name].config
        steps = [run.steps_to(GOOD) for run in runs]
        lines.append(
            [
                name,
                spread(steps, 1.0, 0).replace("inf", "never"),
                f"{sum(map(math.isfinite, steps))} of {len(runs)}",
                spread([run.best[-1] for run in runs]),
                percent(best_on_grid(config).thrust / best_thrust(config)),
                f"{statistics.median(run.cost for run in runs):.1f}",
            ]
        )
    heads = (
        f"training | steps to {100 * GOOD:.0f} % | seeds | best policy (%) | "
        "best whole-tick wave (%) | processor (s for 1000 steps)"
    )
    return f"Median [lowest – highest] of the seeds:\n\n{table(heads, lines)}"


def transfer(options: Namespace) -> Report:
    """Return results of randomised and plain trainings, and of swing, on unknown fish."""
    rows = {
        "`learning-transfer.yaml`": Row(rig(), settings_of("learning-transfer.yaml")),
        "default settings": Row(rig(), settings_of()),
    }
    trainings = train_all(rows, SEEDS[: options.seeds], options, others=True)
    shares = {row: [run.others for run in runs] for row, runs in trainings.items()}
    for text in ("swing:C=0.6", "swing:C=auto"):
        _, name, parameters = parse(text)
        reports = [simulate(one, name, parameters, SECONDS, SETTLE) for one in changed_fish(rig())]
        shares[f"`{text}`"] = [[report.relative_thrust for report in reports]]
    lines = [
        [
            row,
            spread([min(values) for values in runs]),
            spread([statistics.median(values) for values in runs]),
            f"{sum(min(values) >= NEARLY for values in runs)} of {len(runs)}",
        ]
        for row, runs in shares.items()
    ]
    heads = f"controller | worst of 16 fish | median of 16 fish | all ≥ {100 * NEARLY:.0f} %"
    about = f"Relative thrust in %, of policies median [lowest – highest] of {options.seeds} seeds:"
    return Report({"bench learning transfer": f"{about}\n\n{table(heads, lines)}"}, shares)


def unknown(options: Namespace) -> Report:
    """Return results of a shipped policy, of others, and of `swing`, on random fish."""
    with tempfile.TemporaryDirectory() as temporary:
        trainings = [(Path(temporary), seed) for seed in SEEDS[: few(options)]]
        trained = run_cases(train_default, trainings, options.jobs)
        texts = [options.policy, "swing:C=0.6", "swing:C=auto", *trained]
        contestants = [parse(text) for text in texts]
        cases = [(fish, contestants) for kind in UNKNOWN_FISH.values() for fish in kind]
        swims = iter(run_cases(swim_unknown, cases, options.jobs))
    names = [f"`{Path(options.policy).name}`", "`swing:C=0.6`", "`swing:C=auto`"]
    names += [f"default training, seed {seed}" for _, seed in trainings]
    lines, figures = [], {}
    for kind, fish in UNKNOWN_FISH.items():
        bests, surveys = zip(*itertools.islice(swims, len(fish)), strict=True)
        lines.append([kind, "best whole-tick wave", *shares_of(bests), "", ""])
        for name, results in zip(names, zip(*surveys, strict=True), strict=True):
            figures[f"{kind}, {name}"] = results
            lines.append(
                [
                    kind,
                    name,
                    *shares_of([result.relative_thrust for result in results]),
                    str(sum(result.fallback is not None for result in results)),
                    f"{max(result.longest_chatter_s for result in results):.1f}",
                ]
            )
    heads = (
        "fish | controller | median | 10 % quantile | worst | fish below 90 % | fallbacks | "
        "longest chatter, s"
    )
    about = f"Relative thrust in %, on {len(fish)} fish of each kind:"
    return Report({"bench learning unknown": f"{about}\n\n{table(heads, lines)}"}, figures)


def train_default(case: tuple[Path, int]) -> str:
    """Train with the default settings on the default fish; return the path of the policy."""
    folder, seed = case
    job = Job(config=rig(), settings=TrainingSettings(seed=seed), folder=folder / f"seed-{seed}")
    best = train(job).best
    assert best
    return str(export(best, folder / f"{seed}.onnx").path)


def swim_unknown(
    case: tuple[OtherFish, list[Contestant]],
) -> tuple[float, list[FishResult]]:
    """Return the relative thrust of the best whole-tick wave, and the results of contestants."""
    fish, contestants = case
    config = load(None, fish.overrides)
    surveys = survey([(fish, config)], contestants, SECONDS, SETTLE)
    share = best_on_grid(config).thrust / best_thrust(config)
    return share, [surveyed.fish[0] for surveyed in surveys]


def shares_of(shares: Sequence[float]) -> list[str]:
    """Return cells with median, 10 % quantile and worst value, and the number below 90 %."""
    cells = [statistics.median(shares), quantile(shares, 0.1), min(shares)]
    return [*map(percent, cells), str(sum(share < 0.9 for share in shares))]


def speed(options: Namespace) -> Report:
    """Return the steps of the environment per second and the time of an inference, on one core."""
    plain, cnn = settings_of(), settings_of("learning-cnn.yaml")
    cases = {
        "forces, default settings": (plain, DEFAULT),
        "forces, `learning-harsh.yaml`": (settings_of("learning-harsh.yaml"), DEFAULT),
        "`modes`, rig default": (replace(plain, see="camera"), DEFAULT),
        "`modes`, rig web": (replace(plain, see="camera"), WEB),
        "`cnn`, rig default": (cnn, DEFAULT),
        "`cnn`, rig web": (cnn, WEB),
    }
    rows = [[name, f"{steps_per_second(*case):.0f}"] for name, case in cases.items()]
    median, tail = inference_time("default-fish")
    text = (
        f"{table('environment | steps/s, best of five', rows)}\n\nThe controller `ppo` with "
        f"`default-fish`, observation to angle: {median:.1f} µs, p99 {tail:.1f} µs."
    )
    return Report({"bench learning speed": text}, rows)


def steps_per_second(settings: TrainingSettings, camera: SimulatedCameraSettings) -> float:
    """Return the steps per second with random actions and the configured fish."""
    config, extractor = rig(), make_extractor(settings)
    link = SimulatedLink(config)
    if extractor:
        link = SimulatedLink(config, camera=Camera(camera, settings.camera.stack))
    env = SwimEnv(link, config, settings.seen, extractor)
    env.reset(seed=0)
    if extractor:
        env.excite_randomly(0, settings.camera.random_excitation)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (3000, 1)).astype(np.float32)
    rates = []
    for _ in range(5):
        start = time.process_time()
        for action in actions:
            if env.step(action)[3]:
                env.reset()
        rates.append(len(actions) / (time.process_time() - start))
    return max(rates)


def inference_time(policy: str) -> tuple[float, float]:
    """Return median and 99th percentile of the time of an update of `ppo` [µs]."""
    config = rig()
    controller = registry.create("ppo", {"policy": policy}, config.limits)
    observation = SimulatedLink(config).reset()
    times = []
    for _ in range(20_000):
        start = time.perf_counter()
        controller.update(observation)
        times.append(1e6 * (time.perf_counter() - start))
    median, tail = np.percentile(times, (50, 99))
    return float(median), float(tail)


def parse_steps(text: str) -> int:
    """Return a number of control steps that is enough for an evaluation."""
    if not text.isdecimal() or int(text) < MIN_STEPS:
        raise ArgumentTypeError(f"{text}: a whole number of {MIN_STEPS} or more is needed")
    return int(text)


PARTS = {
    "curves": curves,
    "pictures": pictures,
    "transfer": transfer,
    "unknown": unknown,
    "speed": speed,
}
OPTIONS: Options = {
    "--seeds": {"type": int, "default": 10, "help": "trainings of each row; default: 10"},
    "--steps": {
        "type": parse_steps,
        "help": "control steps of each training, as a trial; 512 or more",
    },
    "--policy": {"default": "default-fish", "help": "policy of `unknown`: name or file"},
    "--jobs": {
        "type": int,
        "default": max(1, joblib.cpu_count() - 1),
        "help": "number of processes; default: one less than cores",
    },
}
