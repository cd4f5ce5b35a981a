"""Tank time of a training on a robot, including its evaluations, for `learning tank`.

A simulated fish in virtual time replaces the link to a fishd.
"""

import math
import statistics
import tempfile
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import joblib
import torch
from msgspec.structs import replace

from bench.trainings import CONFIG, UNTOUCHED, rig, settings_of
from common.report import progress, spread, table
from fishd.config import Config, load
from fishd.controllers.dwell import DwellLimit
from fishd.core.camera_frames import Stack
from fishd.core.errors import ParameterError
from fishd.core.signals import Observation
from fishd.lab.links.simulated_link import SimulatedLink
from fishd.lab.measurement import Sample, evaluate, plan
from fishd.learning.env.evaluation import Evaluation, beat_frequency, is_stalled, judge
from fishd.learning.ppo import DeterministicPolicy
from fishd.learning.run_folder.tables import read_evaluations
from fishd.learning.train.jobs import Job
from fishd.learning.train.progress import Display
from fishd.learning.train.training import Training

STEPS = 2048
GOOD_RELATIVE_THRUST = 0.97
AFTER = (60.0, 120.0, 180.0, 300.0)
"""Tank times at which results are compared [s]."""
BEFORE = 30.0
"""Duration of an evaluation by the former rule, without comparison of policies [s]."""


class Run(NamedTuple):
    """Result of one training."""

    bests: list[tuple[float, float]]
    """Tank times [s], and true relative thrusts of the best policy from then on."""
    highest: float
    """True relative thrust of the best of all candidates."""
    tank_time: float
    """Total tank time [s]."""

    def at(self, seconds: float) -> float:
        """Return the relative thrust of the best policy at a tank time; 0 before the first one."""
        return next((share for time, share in reversed(self.bests) if time <= seconds), 0.0)

    @property
    def reached(self) -> float:
        """Return the first time at which the best policy had `GOOD_RELATIVE_THRUST` [s]."""
        return next((time for time, share in self.bests if share >= GOOD_RELATIVE_THRUST), math.inf)


class Comparing(Training):
    """Unchanged training that records the true relative thrust of each candidate."""

    truth: dict[int, float]

    def _policy(self) -> DeterministicPolicy:
        env = self._env
        return DeterministicPolicy(self._model.policy, env.perception, env.link.amplitude)

    def _evaluate(self) -> None:
        self.truth[self._recorder.steps] = true_relative_thrust(self._job.config, self._policy())
        super()._evaluate()


class OneByOne(Comparing):
    """Former rule: each policy is measured once, for `BEFORE`, and the highest is the best."""

    def _evaluate(self) -> None:
        env, decide, steps = self._env, self._policy(), self._recorder.steps
        self.truth[steps] = true_relative_thrust(self._job.config, decide)
        env.resume()
        tick, samples = env.link.tick, []
        for swims, seconds in plan(BEFORE, {}):
            for _ in range(round(seconds / tick)):
                seen = env.latest
                angle = decide(seen) if swims else 0.0
                seq = round(seen.time / tick)
                samples.append(Sample(seq, seen.fx, seen.fin_velocity, angle, swims))
                env.swim(angle)
        env.pause()
        shares = torch.tensor([each.phi_c for each in samples if each.swims]).numpy()
        shares /= env.link.amplitude
        frequency, fullness = beat_frequency(shares, tick), float(abs(shares).mean())
        try:
            evaluation = evaluate(samples, tick)
        except ParameterError:
            return
        row = Evaluation(
            steps=steps,
            policy=steps,
            tank_time=env.tank_time,
            thrust=evaluation.thrust,
            error=evaluation.error,
            relative_thrust=evaluation.thrust / env.best_thrust,
            frequency=frequency,
            fullness=fullness,
            stalled=is_stalled(frequency, fullness, tick),
        )
        self._recorder.add(row)


def true_relative_thrust(config: Config, decide: DeterministicPolicy) -> float:
    """Return the relative thrust of `ppo` without noise and drift; 0 after a takeover."""
    quiet = replace(config.simulation, noise=0.0, drift=0.0)
    limits = config.limits
    limit = DwellLimit(limits.dwell, limits, config.amplitude_limit)

    def limited(seen: Observation, stack: Stack | None) -> float:
        return limit.apply(decide(seen, stack), seen.dt)

    report = judge(replace(config, simulation=quiet), limited, 30.0, 10.0)
    return 0.0 if report.fallback else report.relative_thrust


def trained(config: Config, seed: int, kind: type[Comparing]) -> Run:
    """Train once, in a separate process."""
    torch.set_num_threads(1)
    config = replace(config, simulation=replace(config.simulation, seed=seed))
    settings = replace(settings_of(None, STEPS), seed=seed)
    with tempfile.TemporaryDirectory() as temporary:
        job = Job(config=config, settings=settings, folder=Path(temporary) / "run", on="live")
        training = kind(job, SimulatedLink(config), Display(), lambda: False)
        training.truth = {}
        outcome = training.run()
        rows = [row for row in read_evaluations(job.folder) if row.best]
    bests = [(row.tank_time, training.truth[row.policy]) for row in rows]
    return Run(bests, max(training.truth.values()), outcome.tank_time)


def tank(options: Namespace) -> str:
    """Return the tank time until the best policy of a training is good, and its thrust."""
    rigs = {
        "Φ = 0.42 rad": rig(),
        "`config/simulated.yaml`": load(CONFIG / "simulated.yaml"),
        "Φ = 0.2 rad": rig(0.2),
    }
    rules = {"the bandit": Comparing, f"each once, for {BEFORE:g} s": OneByOne}
    seeds = UNTOUCHED[: options.seeds]
    runs_by_row = _all(rigs, rules, seeds, options.jobs)
    lines = []
    for (fish, rule), runs in runs_by_row.items():
        short = [run.highest - run.at(math.inf) for run in runs]
        lines.append(
            [
                fish,
                rule,
                str(len(runs)),
                _seconds([run.reached for run in runs]),
                *(spread([run.at(seconds) for run in runs]) for seconds in AFTER),
                spread([run.at(math.inf) for run in runs]),
                spread(short),
                f"{statistics.median(run.tank_time for run in runs):.0f}",
            ]
        )
    heads = " | ".join(
        (
            "fish | rule that chooses the best | seeds | tank time to 97 % (s)",
            *(f"after {seconds / 60:g} min" for seconds in AFTER),
            f"after {STEPS} steps | % below the best candidate | total tank time (s)",
        )
    )
    return (
        "True relative thrust (%) of the policy that the rule chooses as the best, median "
        f"[lowest – highest] of {len(seeds)} seeds:\n\n{table(heads, lines)}"
    )


def _all(
    rigs: Mapping[str, Config],
    rules: Mapping[str, type[Comparing]],
    seeds: Sequence[int],
    jobs: int,
) -> dict[tuple[str, str], list[Run]]:
    rows = [(fish, rule) for fish in rigs for rule in rules]
    tasks = [(row, seed) for row in rows for seed in seeds]
    runs_by_row: dict[tuple[str, str], list[Run]] = {row: [] for row in rows}
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=jobs, batch_size=1, return_as="generator")
        work = parallel(
            joblib.delayed(trained)(rigs[fish], seed, rules[rule]) for (fish, rule), seed in tasks
        )
        for (row, seed), run in zip(tasks, work, strict=True):
            runs_by_row[row].append(run)
            progress(*row, f"seed {seed}", f"{run.reached:.0f} s", f"{run.at(math.inf):.1%}")
    return runs_by_row


def _seconds(values: Sequence[float]) -> str:
    """Format like `spread`, where some values may be infinite."""
    if math.isinf(max(values)):
        middle, low = statistics.median(values), min(values)
        return f"{middle:.0f} [{low:.0f} – never]".replace("inf", "never")
    return spread(values, 1.0, 0)
