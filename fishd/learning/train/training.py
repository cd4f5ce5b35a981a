"""The whole loop of learning: swim, update, evaluate, keep; in simulation or on a robot.

rollout    n_steps of exploration; the fish then waits at neutral
update     PPO learns from them
evaluate   without exploration: a simulated fish of its own, or the robot itself
keep       a row in the tables, a checkpoint where one is due, another where it is the best yet
"""

import shlex
from collections.abc import Callable
from contextlib import closing
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv

from fishd.errors import FishdError
from fishd.learning import checkpoints, runs
from fishd.learning.callbacks import Watch
from fishd.learning.checkpoints import CheckpointError, Evaluation
from fishd.learning.environment import SwimEnv
from fishd.learning.jobs import Ended, Job, Outcome
from fishd.learning.keeping import Keeper
from fishd.learning.link import Link, LinkLost
from fishd.learning.links import check_agreement, in_process, on_daemon
from fishd.learning.ppo import (
    Deterministic,
    is_finite,
    learning_rate,
    make_learner,
    set_learning_rate,
)
from fishd.learning.progress import Quiet, Show, minutes
from fishd.learning.trials import in_simulation, on_link, worst_of_others
from fishd.plant.optimum import best_square_wave

__all__ = ["Job", "Outcome", "train"]

_NEVER = 10**9
"""Updates after which stable-baselines3 logs by itself."""


def train(job: Job, show: Show | None = None, stop: Callable[[], bool] = lambda: False) -> Outcome:
    """Train; whatever ends it, the fish is at neutral afterwards.

    stop: asked after each step whether to end here; what the present rollout has seen is then lost

    Raises `ConfigError`, `CheckpointError` and `FishError` before anything has moved, and
    `CheckpointError` where the run folder cannot be written any more.
    """
    torch.set_num_threads(1)
    if job.on == "robot":
        link = on_daemon(job.endpoint, job.agent)
    else:
        link = in_process(job.config, job.settings)
    try:
        check_agreement(link, job.config)
        return Training(job, link, show or Quiet(), stop).run()
    except OSError as error:
        if isinstance(error, FishdError):
            raise
        raise CheckpointError(
            f"{error.filename or job.folder}: cannot be written: {error.strerror}; when that is "
            f"mended, {_way_on(job)}"
        ) from error
    finally:
        link.close()


def _way_on(job: Job) -> str:
    """What to do after the run folder could not be written."""
    folder = shlex.quote(str(job.folder))
    if runs.has_checkpoint(job.folder):
        return f"go on from the newest checkpoint with --resume {folder}"
    robot = " --on robot" if job.on == "robot" else ""
    return (
        f"remove {job.folder}, which has no checkpoint yet, and start again with 'fishctl learn "
        f"ppo{robot} --folder {folder}' and what else you gave"
    )


class Training:
    """One training on one link, which it leaves at neutral."""

    def __init__(self, job: Job, link: Link, show: Show, stop: Callable[[], bool]) -> None:
        """Makes or opens the run folder; nothing moves yet. Raises as `train` does."""
        self._job, self._show, self._stop = job, show, stop
        self._env = SwimEnv(link, job.config, job.settings.environment)
        self._vec_env = DummyVecEnv([lambda: self._env])
        self._model = make_learner(job.settings, self._vec_env)
        self._watch = Watch(self._env, stop, lambda: show.step(self._env.tank_time))
        self._yardstick = float(best_square_wave(job.config.plant, link.amplitude).thrust)
        self._keeper = Keeper(job, self._env, self._model, self._yardstick)
        self._paused = False

    def run(self) -> Outcome:
        """Learn until all steps are done, or something ends it."""
        with closing(self._keeper):
            return self._run()

    def _run(self) -> Outcome:
        keeper, job = self._keeper, self._job
        self._introduce()
        ended: Ended = "finished"
        message = ""
        try:
            self._reset()
            while keeper.steps < job.settings.steps and ended == "finished":
                ended, message = self._update()
        except LinkLost as error:
            ended, message = "lost", str(error)
        finally:
            self._env.close()  # neutral first, then all that takes time
        if ended != "diverged":
            keeper.keep()
        return Outcome(
            folder=job.folder,
            steps=keeper.steps,
            dropped=self._watch.moves if self._watch.stopped else 0,
            tank_time=self._env.tank_time,
            ended=ended,
            message=message,
            checkpoint=keeper.checkpoint,
            best=checkpoints.best(job.folder),
            latest_evaluation=keeper.latest,
            best_evaluation=keeper.best,
        )

    def _introduce(self) -> None:
        keeper, job = self._keeper, self._job
        last, rollout = job.last_step(keeper.steps), job.settings.ppo.n_steps
        whole = f", in whole rollouts of {rollout}" if last != job.settings.steps else ""
        where = f"{job.folder}: {last} steps{whole} on {job.on}"
        if keeper.resumed:
            where += (
                f", on from {keeper.checkpoint}, {minutes(keeper.resumed.tank_time)} in the tank"
            )
        self._show.begin(keeper.steps, last, where)

    def _reset(self) -> None:
        """Let the first episode begin; of a resumed run, with random numbers that go on."""
        self._start_with(cast(NDArray[np.float32], self._vec_env.reset()))
        if self._keeper.resumed and self._keeper.steps:  # else it begins as it did before
            checkpoints.restore_random_state(self._keeper.resumed.random, self._env.np_random)

    def _start_with(self, observations: NDArray[np.float32]) -> None:
        """What the next rollout begins with: nothing links it to the one before."""
        self._model._last_obs = observations
        self._model._last_episode_starts = np.ones(1, dtype=bool)

    def _update(self) -> tuple[Ended, str]:
        """One rollout and what follows from it; how it ended."""
        model, settings, keeper = self._model, self._job.settings, self._keeper
        if self._paused:
            self._start_with(self._env.resume()[np.newaxis])
            self._paused = False
        before = keeper.steps
        set_learning_rate(model, learning_rate(settings.ppo, before + settings.ppo.n_steps))
        try:
            model.learn(
                settings.ppo.n_steps, self._watch, log_interval=_NEVER, reset_num_timesteps=False
            )
        except ValueError:  # so torch calls a distribution without a mean
            if is_finite(model):
                raise
        if self._watch.stopped:
            model.num_timesteps = before  # the policy is still the one of then
            return "interrupted", ""
        self._paused = True
        if not is_finite(model):
            return "diverged", (
                f"learning blew up in the update after {model.num_timesteps} steps; "
                "lower ppo.learning_rate or ppo.clip_range"
            )
        keeper.steps = model.num_timesteps
        keeper.rollouts += 1
        figures = self._watch.figures()
        self._show.update(
            keeper.steps, figures.thrust, figures.thrust / self._yardstick, figures.frequency
        )
        every, last = settings.evaluation.every, keeper.steps >= settings.steps
        if every and (last or keeper.rollouts % every == 0):
            self._evaluate()
        keeper.log(figures)
        every = settings.checkpoint_every
        keeper.keep(due=last or before // every < keeper.steps // every)
        return ("interrupted" if self._stop() and not last else "finished"), ""

    def _evaluate(self) -> None:
        """Judge the policy without exploration."""
        job, env = self._job, self._env
        worst = None
        decide = Deterministic(self._model.policy, env.features, env.link.amplitude)
        if job.on == "simulation":
            trial = in_simulation(job.config, decide, job.settings.evaluation)
            if job.settings.evaluation.others:
                others = worst_of_others(job.config, decide, job.settings)
                worst = min(others, trial.thrust / self._yardstick)
        else:
            env.resume()
            found = on_link(env, decide, job.settings.evaluation, self._stop)
            env.pause()
            if found is None:
                return
            trial = found
        evaluation = Evaluation(
            steps=self._keeper.steps,
            tank_time=env.tank_time,
            thrust=trial.thrust,
            efficiency=trial.thrust / self._yardstick,
            frequency=trial.frequency,
            fullness=trial.fullness,
            stalled=trial.stalled,
            worst=worst,
        )
        self._show.evaluated(evaluation, best=self._keeper.evaluated(evaluation))
