"""Results of learning: learning curves, policies on unknown fish, and speed.

Trainings are those of `fishctl learn ppo`, in a temporary folder. Relative thrust is the thrust
over that of the best square wave of the same fish and amplitude.

    relative_thrust  learning curves: several fish and settings; draws learning-curves.png
    amplitude        Φ = 0.3 rad, where two waves of whole ticks are nearly as good
    exploration      why one of these seeds goes to five ticks and stays there
    choices          what each of the default settings is worth
    transfer         policies for one fish on sixteen others
    tank             tank time of trainings on a robot, evaluations included
    harsh            the policy that is shipped, and swing, on rigs that delay, play and react
    speed            environment and inference, on one core
    time             whole runs of `fishctl learn ppo`, one at a time
"""

import itertools
import math
import statistics
import time
from argparse import Namespace
from collections.abc import Callable

import joblib
import numpy as np
from msgspec.structs import replace

from bench.learning_curves import learning_curves
from bench.middle_amplitude import amplitude, exploration
from bench.policy import policy_file
from bench.tank_time import tank
from bench.training_time import training_time
from bench.trainings import (
    CONFIG,
    SECONDS,
    SETTLE,
    UNTOUCHED,
    Row,
    Trained,
    fish_that_are_off,
    rig,
    settings_of,
    several,
    to_reach,
)
from common.report import DOCS, Options, Report, progress, spread, table
from fishd.config import Config, load
from fishd.controllers import registry
from fishd.lab.compare.contestants import best_on_grid, parse
from fishd.lab.compare.survey import survey
from fishd.lab.links.simulated_link import SimulatedLink
from fishd.lab.other_fish import CHANGES, FIRST_SEED, HARSH_FISH_COUNT, harsh_fish, mild
from fishd.lab.other_fish import harsh as harsh_of_seed
from fishd.lab.simulation import simulate
from fishd.learning.env.environment import SwimEnv, best_thrust
from fishd.learning.settings import TrainingSettings
from fishd.virtual.plant.optimum import best_square_wave

DOCUMENT = "how-to/learning.md"
FIGURE = DOCS / "figures" / "learning-curves.png"
MILESTONES = (500, 1000, 2000, 4000, 8000, 20_000)
"""Numbers of control steps at which learning curves are reported."""
PAPER_STEPS, CHOICE_STEPS = 20_000, 3000
CHOOSING = range(300, 310)
"""Seeds with which settings were compared."""
SHIPPED, SWINGS = "default-fish", ("swing:C=0.6", "swing:C=auto")
MANY_SEEDS = range(1000, 1040)
"""Seeds of mild and harsh fish that no policy was trained or chosen with."""
GOOD = 0.95
"""Goal for the relative thrust of a policy on each of sixteen fish."""
SIMULATED = "`config/simulated.yaml`"
NEARLY, GOOD_RELATIVE_THRUST = 0.95, 0.97
REACHED = f" | {100 * NEARLY:.0f} % | seeds | {100 * GOOD_RELATIVE_THRUST:.0f} % | seeds"
STALLED = 0.5
"""Relative thrust below which a policy counts as stalled."""


def relative_thrust(options: Namespace) -> str:
    """Draw learning curves of the default settings on several fish, and of two other settings."""
    plain, paper = settings_of(None), settings_of("learning-paper.yaml", PAPER_STEPS)
    blind = replace(plain, ppo=replace(plain.ppo, symmetric=False))
    rows = {
        "Φ = 0.42 rad": Row(rig(), plain),
        "Φ = 0.2 rad": Row(rig(0.2), plain),
        "Φ = 0.8 rad": Row(rig(0.8), plain),
        SIMULATED: Row(load(CONFIG / "simulated.yaml"), plain),
        "`config/harsh.yaml`": Row(load(CONFIG / "harsh.yaml"), plain),
        "Φ = 0.42 rad, without symmetry": Row(rig(), blind),
        "Φ = 0.42 rad, as in the paper": Row(rig(), paper),
    }
    trainings = several(rows, UNTOUCHED[: options.seeds], options.jobs)
    picture = {
        row.replace("`", ""): [
            ([p.steps for p in one.points], [p.relative_thrust for p in one.points]) for one in runs
        ]
        for row, runs in trainings.items()
        if row != SIMULATED
    }
    if options.write:
        learning_curves(FIGURE, picture, GOOD_RELATIVE_THRUST)
    heads = " | ".join(["", "seeds", *(f"{steps} steps" for steps in MILESTONES)])
    reached, learned, best, shape = [], [], [], []
    for row, runs in trainings.items():
        reached.append([row, *to_reach(runs, NEARLY), *to_reach(runs, GOOD_RELATIVE_THRUST)])
        learned.append(
            [row, str(len(runs)), *curve_of(runs, lambda one, k: one.points[k].relative_thrust)]
        )
        best.append([row, str(len(runs)), *curve_of(runs, lambda one, k: one.best[k])])
        config = rows[row].config
        grid = best_on_grid(config)
        limit = grid.thrust / best_square_wave(config.plant, config.amplitude_limit).thrust
        ends = [one.points[-1] for one in runs]
        stalled = sum(end.relative_thrust < STALLED for end in ends)
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
        "fish | mean \\|φ_c\\|/Φ | frequency (Hz) | best whole-tick wave (Hz) | "
        "its relative thrust (%) | stalled"
    )
    return "\n\n".join(
        (
            f"Steps until the best policy so far has that relative thrust, median [lowest – "
            f"highest] of {options.seeds} seeds:",
            table(REACHED, reached),
            "Relative thrust (%) of the best policy of a seed so far, the one that `export` takes:",
            table(heads, best),
            "The same for the newest policy instead of the best one:",
            table(heads, learned),
            "Commands of the newest policy at the end:",
            table(shape_heads, shape),
        )
    )


def choices(options: Namespace) -> str:
    """Return the effect of each of the default settings, on two fish where it matters."""
    plain = settings_of(None, CHOICE_STEPS)
    ppo, seen = plain.ppo, plain.environment
    others = tuple(name for name in seen.observation if name != "side_time")
    variants = {
        "default settings": plain,
        "128 steps between updates": replace(
            plain,
            ppo=replace(ppo, n_steps=2 * ppo.n_steps),
            evaluation=replace(plain.evaluation, every=plain.evaluation.every // 2),
        ),
        "ten passes over each rollout": replace(plain, ppo=replace(ppo, n_epochs=10)),
        "initial exploration of 2 Φ": replace(plain, ppo=replace(ppo, log_std_init=math.log(2))),
        "without the input `side_time`": replace(
            plain, environment=replace(seen, observation=others)
        ),
        "F_x uncorrected (`clean_rewards: false`)": replace(
            plain, ppo=replace(ppo, clean_rewards=False)
        ),
        "without the shortest dwell": replace(plain, environment=replace(seen, dwell=False)),
    }
    fish = {
        "Φ = 0.2 rad": (rig(0.2), GOOD_RELATIVE_THRUST),
        "`config/harsh.yaml`": (load(CONFIG / "harsh.yaml"), NEARLY),
    }
    rows = {
        f"{one}, {name}": Row(config, chosen)
        for name, chosen in variants.items()
        for one, (config, _) in fish.items()
    }
    trainings = several(rows, CHOOSING[: options.seeds], options.jobs)
    table_rows = [
        [
            name,
            *itertools.chain.from_iterable(
                to_reach(trainings[f"{one}, {name}"], share) for one, (_, share) in fish.items()
            ),
        ]
        for name in variants
    ]
    heads = " | ".join(
        ["", *(f"{one}: steps to {100 * share:.0f} % | seeds" for one, (_, share) in fish.items())]
    )
    return table(heads, table_rows)


def curve_of(runs: list[Trained], figure: Callable[[Trained, int], float]) -> list[str]:
    """Return the cells of a row: one for each milestone until the training's end."""
    cells = []
    for steps in MILESTONES:
        known = [sum(point.steps <= steps for point in one.points) for one in runs]
        over = steps > max(one.points[-1].steps for one in runs)
        shares = [figure(one, count - 1) for one, count in zip(runs, known, strict=True) if count]
        cells.append("" if over or not shares else spread(shares))
    return cells


def transfer(options: Namespace) -> str:
    """Return results of randomised and plain trainings, and of swing, on unknown fish."""
    rows = {
        "`learning-transfer.yaml`": Row(rig(), settings_of("learning-transfer.yaml")),
        "default settings": Row(rig(), settings_of(None)),
    }
    trainings = several(rows, UNTOUCHED[: options.seeds], options.jobs, others=True)
    shares = {row: [one.others for one in runs] for row, runs in trainings.items()}
    for text in SWINGS:
        _, name, parameters = parse(text)
        fish = fish_that_are_off(rig())
        shares[f"`{text}`"] = [
            [simulate(one, name, parameters, SECONDS, SETTLE).relative_thrust for one in fish]
        ]
    lines = [
        [
            row,
            spread([min(values) for values in runs]),
            spread([statistics.median(values) for values in runs]),
            f"{sum(min(values) >= GOOD for values in runs)} of {len(runs)}",
        ]
        for row, runs in shares.items()
    ]
    heads = f"controller | worst of 16 fish | median of 16 fish | all ≥ {100 * GOOD:.0f} %"
    of_seeds = (
        "Relative thrust in %; for policies the median [lowest – highest] of "
        f"{options.seeds} seeds:"
    )
    return f"{of_seeds}\n\n{table(heads, lines)}"


def harsh(options: Namespace) -> str:
    """Return the results of `fishctl learn evaluate --fish harsh`, and of mild fish."""
    changes, random = list(CHANGES), list(harsh_fish())
    clean = [mild(FIRST_SEED + number) for number in range(HARSH_FISH_COUNT)]
    configs = [(fish, load(None, fish.overrides)) for fish in (*changes, *random, *clean)]
    contestants = [parse(text) for text in (SHIPPED, *SWINGS)]
    results = survey(configs, contestants, SECONDS, SETTLE)
    rows = [
        [fish.name, *(f"{100 * one.fish[row].relative_thrust:.1f}" for one in results)]
        for row, fish in enumerate(changes)
    ]
    first = len(changes)
    for kind, group in (("harsh", random), ("mild", clean)):
        groups = [one.fish[first : first + len(group)] for one in results]
        for name, pick in (("median", statistics.median), ("worst", min)):
            figures = [pick(swum.relative_thrust for swum in row) for row in groups]
            rows.append(
                [f"{len(group)} {kind} fish, {name}", *(f"{100 * share:.1f}" for share in figures)]
            )
        first += len(group)
    lost = [sum(swum.fallback is not None for swum in one.fish) for one in results]
    rows.append(["runs in which another controller took over", *map(str, lost)])
    shaken = [max(swum.shaken for swum in one.fish) for one in results]
    longest = "longest time of reversals in consecutive ticks, s"
    rows.append([longest, *(f"{s:.1f}" for s in shaken)])
    heads = " | ".join(["fish", *(f"`{one.contestant}`" for one in results)])
    return "\n\n".join(
        (
            "Relative thrust in % over a minute without its first 10 s:",
            table(heads, rows),
            f"`{SHIPPED}` on {len(MANY_SEEDS)} more fish of each kind, seeds {MANY_SEEDS[0]} to "
            f"{MANY_SEEDS[-1]}:",
            on_many_fish(),
        )
    )


def on_many_fish() -> str:
    """Return the table of the shipped policy on many mild and harsh fish."""
    rows = []
    for kind, fish_of_seed in (("mild", mild), ("harsh", harsh_of_seed)):
        fish = [fish_of_seed(seed) for seed in MANY_SEEDS]
        configs = [load(None, each.overrides) for each in fish]
        (result,) = survey(list(zip(fish, configs, strict=True)), [parse(SHIPPED)], SECONDS, SETTLE)
        shares = [swum.relative_thrust for swum in result.fish]
        grids = [best_on_grid(config).thrust / best_thrust(config) for config in configs]
        limits = [statistics.median(shares), *np.quantile(shares, (0.1, 0.05)), min(shares)]
        cells = [*limits, statistics.median(grids), min(grids)]
        low = (f"{sum(share < limit for share in shares)}" for limit in (0.95, 0.9))
        rows.append([kind, *(f"{100 * share:.1f}" for share in cells), *low])
    heads = (
        "fish | median | 10 % quantile | 5 % quantile | worst | best whole-tick wave, median | "
        "best whole-tick wave, worst | fish below 95 % | fish below 90 %"
    )
    return table(heads, rows)


def speed(options: Namespace) -> str:
    """Return the steps of the environment per second and the time of an inference, on one core."""
    config = rig()
    lines = []
    for name, file in (
        ("default settings", None),
        ("`learning-harsh.yaml`", "learning-harsh.yaml"),
    ):
        lines.append(f"- environment, {name}, {steps_per_second(config, settings_of(file))}")
    with policy_file(None) as file:
        lines.append(f"- the controller `ppo`, default settings, {inference(config, file)}")
    lines.append(f"- the controller `ppo`, `{SHIPPED}`, {inference(config, SHIPPED)}")
    return "\n".join(lines)


def steps_per_second(config: Config, settings: TrainingSettings) -> str:
    """Return the steps per second with random actions and the configured fish, on one core."""
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


def inference(config: Config, policy: str) -> str:
    """Return the time of the controller `ppo` in the tick."""
    controller = registry.create("ppo", {"policy": policy}, config.limits)
    observation = SimulatedLink(config).reset()
    times = []
    for _ in range(20_000):
        begun = time.perf_counter()
        controller.update(observation)
        times.append(1e6 * (time.perf_counter() - begun))
    median, tail = np.percentile(times, (50, 99))
    return f"observation to angle: {median:.1f} µs, p99 {tail:.1f} µs"


PARTS = {
    "relative_thrust": relative_thrust,
    "amplitude": amplitude,
    "exploration": exploration,
    "choices": choices,
    "transfer": transfer,
    "tank": tank,
    "harsh": harsh,
    "speed": speed,
    "time": training_time,
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
    """Return the requested parts."""
    sections = {}
    for part in PARTS if options.part == "all" else (options.part,):
        begun = time.perf_counter()
        sections[f"bench learning {part}"] = PARTS[part](options)
        progress(part, f"{time.perf_counter() - begun:.0f} s")
    return Report(sections, sections)
