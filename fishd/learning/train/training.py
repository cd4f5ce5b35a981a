"""The training loop, in simulation or on a robot.

imitate    if the settings enable it, simulated fish whose best beat is known; then, in turn:
rollout    n_steps of exploration; the fish then waits at neutral
update     PPO learns from them
evaluate   without exploration: on a separate simulated fish, or in the tank
record     a row in the tables, a checkpoint if one is due, another if the policy is the best yet

In simulation the untrained policy, and the policies of the first updates, are evaluated, too.
"""

import shlex
from collections.abc import Callable
from contextlib import closing
from typing import cast

import numpy as np
import torch
from msgspec.structs import replace
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv

from fishd.core.errors import FishdError
from fishd.learning import extractors
from fishd.learning.batched_imitation import BatchedImitation
from fishd.learning.env import evaluation
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.env.fish_variation import episode_fish
from fishd.learning.imitation import Imitation
from fishd.learning.links.fishd_link import FishdLink
from fishd.learning.links.link import Link, LinkLost
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.ppo import DeterministicPolicy, Rollout, is_finite, learning_rate, make_learner
from fishd.learning.run_folder import checkpoints
from fishd.learning.run_folder.checkpoints import CheckpointError
from fishd.learning.thrust_signal import ThrustSignal
from fishd.learning.train.candidates import TankEvaluations
from fishd.learning.train.jobs import Ended, Job, Outcome
from fishd.learning.train.progress import NOT_COUNTED, Display, format_minutes
from fishd.learning.train.recorder import RunRecorder
from fishd.learning.train.rollouts import Rollouts

FIRST_UPDATES = 16
"""Number of updates at the start that are all evaluated in simulation, so that the learning curve
shows how the thrust rises."""
_WHERE = {"live": "on the fish of fishd", "simulation": "in simulation"}


def train(
    job: Job, display: Display | None = None, stop: Callable[[], bool] = lambda: False
) -> Outcome:
    """Train; the fish is at neutral afterwards, whatever ends the training.

    stop: called at first and after each step; True ends the training there, and drops the
        current rollout

    Raises `ConfigError`, `CheckpointError` and `FishError` before anything has moved, and
    `CheckpointError` where the run folder can no longer be written.
    """
    job.check()
    link: Link
    if job.on == "live":
        stack = job.settings.camera.stack if job.settings.see != "force" else None
        link = FishdLink(
            job.endpoint,
            "learn ppo",
            job.take,
            address=job.agent,
            stack=stack,
            camera=job.camera_endpoint,
        )
    else:
        link = SimulatedLink(
            job.config,
            episode_fish(job.settings.randomisation),
            job.simulated_camera,
            metered=bool(job.settings.environment.power_price),
        )
    try:
        return Training(job, link, display or Display(), stop).run()
    except OSError as error:
        if isinstance(error, FishdError):
            raise
        raise CheckpointError(
            f"{error.filename or job.folder}: cannot be written: {error.strerror}; when that is "
            f"mended, {_format_advice(job)}"
        ) from error
    finally:
        link.close()


class Training:
    """A training on one link, with the fish at neutral at its end."""

    def __init__(self, job: Job, link: Link, display: Display, stop: Callable[[], bool]) -> None:
        """Create or open the run folder; nothing moves yet. Raises as `train` does."""
        torch.set_num_threads(1)
        # `_update` detects a policy that is not finite; torch would raise a ValueError before that.
        torch.distributions.Distribution.set_default_validate_args(False)
        self._job, self._display, self._stop = job, display, stop
        self._extractor = extractors.make_extractor(job.settings)
        self._env = SwimEnv(link, job.config, job.settings.seen, self._extractor)
        self._vec_env = DummyVecEnv([lambda: self._env])
        self._model = make_learner(job.settings, self._vec_env, self._extractor)
        if job.cleans_rewards:
            _enable_cleaning(cast(Rollout, self._model.rollout_buffer), self._env)
        self._rollouts = Rollouts(self._model, self._env, display, stop)
        self._recorder = RunRecorder(job, self._env, self._model)
        self._tank = TankEvaluations(self._model, self._env, self._recorder.winner, stop)
        if job.parent and not job.resume:
            self._tank.add(0, 0)  # learning may make it worse
        self._paused = False

    def run(self) -> Outcome:
        """Learn until all steps are done, or the training is stopped or fails."""
        with closing(self._recorder):
            return self._run()

    def _run(self) -> Outcome:
        recorder, job = self._recorder, self._job
        self._introduce()
        ended: Ended = "finished"
        message = ""
        try:
            if self._stop():  # while torch was loading: the fish stays at rest
                ended = "interrupted"
            elif job.settings.imitation.rounds and not recorder.imitated:
                ended = self._imitate()
            if ended == "finished":
                self._reset()
            if ended == "finished" and self._extractor and not self._extractor.is_fitted:
                ended, message = self._excite_randomly()
            if ended == "finished" and not message:
                self._evaluate_untrained()
            while recorder.steps < job.settings.steps and ended == "finished" and not message:
                ended, message = self._update()
        except LinkLost as error:
            ended, message = "lost", str(error)
        finally:
            self._env.close()  # neutral first, then all that takes time
        if ended != "diverged":
            recorder.save()
        return Outcome(
            folder=job.folder,
            steps=recorder.steps,
            dropped=self._rollouts.dropped,
            tank_time=self._env.tank_time,
            ended=ended,
            message=message,
            checkpoint=recorder.checkpoint,
            best=checkpoints.best(job.folder),
            latest_evaluation=recorder.latest,
            best_evaluation=recorder.best,
        )

    def _introduce(self) -> None:
        recorder, job = self._recorder, self._job
        done, rollout = recorder.steps, job.settings.ppo.n_steps
        if self._extractor and not self._extractor.is_fitted:
            done = job.settings.camera.random_excitation
        last = job.last_step(done)
        whole = f", in whole rollouts of {rollout}" if last != job.settings.steps else ""
        most = "at most " if job.on == "simulation" and job.settings.evaluation.patience else ""
        text = f"{job.folder}: {most}{last} steps{whole} {_WHERE[job.on]}"
        if self._extractor:
            also = " and forces" if job.settings.see == "both" else ""
            kind = job.settings.camera.feature_extractor
            text += f", from pictures{also} with the feature extractor {kind}"
        if job.settings.imitation.rounds and not recorder.imitated:
            fish = job.settings.imitation.rounds * job.settings.imitation.fish
            text += f", after an imitation of the best beats of {fish} fish"
        if job.resume:
            tank = format_minutes(self._env.tank_time)
            text += f", resumed from {recorder.checkpoint}, {tank} in the tank"
        if job.on == "simulation" and job.settings.evaluation.every:
            text += f"; tank times are{NOT_COUNTED}"
        self._display.begin(recorder.steps, last, text)

    def _reset(self) -> None:
        """Begin the first episode; a resumed run uses other random numbers."""
        if self._recorder.steps:
            mixed = np.random.SeedSequence([self._job.settings.seed, self._recorder.steps])
            self._model.set_random_seed(int(mixed.generate_state(1)[0]))
        self._rollouts.begin(cast(NDArray[np.float32], self._vec_env.reset())[0])

    def _excite_randomly(self) -> tuple[Ended, str]:
        """Move at random first, to fit the extractor to its pictures; these steps count, too."""
        env, ticks = self._env, self._job.settings.camera.random_excitation

        def stop() -> bool:
            self._display.step(env.tank_time)
            return self._stop()

        if not env.excite_randomly(self._job.settings.seed, ticks, stop):
            return "interrupted", ""
        self._paused = True
        self._recorder.steps = self._model.num_timesteps = ticks
        return "finished", ""

    def _imitate(self) -> Ended:
        """Learn from the best waves of other fish first; an interrupted imitation is repeated."""
        rounds = self._job.settings.imitation.rounds
        kind = BatchedImitation if self._job.settings.imitation.batched else Imitation
        imitation = kind(self._job.config, self._job.settings, self._model.policy)
        for number in range(1, rounds + 1):
            right = imitation.round(self._stop)
            if right is None:
                return "interrupted"
            self._display.imitated(number, rounds, right)
        self._recorder.imitated = True
        if self._job.settings.evaluation.every:
            self._evaluate()
        self._recorder.save(policy_changed=True)
        return "finished"

    def _update(self) -> tuple[Ended, str]:
        """Do one rollout, its update and evaluation; return how it ended, and why."""
        model, settings, recorder = self._model, self._job.settings, self._recorder
        if self._paused:
            self._rollouts.begin(self._env.resume())
            self._paused = False
        before = recorder.steps
        if not self._rollouts.collect():
            return "interrupted", ""
        self._paused = True
        model.num_timesteps += settings.ppo.n_steps
        rate = learning_rate(settings.ppo, model.num_timesteps)
        model.lr_schedule = lambda _: rate  # independent of the progress that PPO computes
        model.train()
        if not is_finite(model):
            return "diverged", (
                f"learning diverged in the update after {model.num_timesteps} steps; "
                "lower ppo.learning_rate or ppo.clip_range"
            )
        recorder.steps = model.num_timesteps
        recorder.rollouts += 1
        every, last = settings.evaluation.every, recorder.steps >= settings.steps
        first = self._job.on == "simulation" and recorder.rollouts <= FIRST_UPDATES
        try:
            if every and (last or first or recorder.rollouts % every == 0):
                self._evaluate()
        finally:
            recorder.log()
        every = settings.checkpoint_every
        recorder.save(due=last or before // every < recorder.steps // every)
        if recorder.has_converged and not last:
            return "finished", (
                f"ended early: the last {recorder.unimproved} evaluations have shown no better "
                "policy (evaluation.patience)"
            )
        return ("interrupted" if self._stop() and not last else "finished"), ""

    def _evaluate_untrained(self) -> None:
        """Evaluate the policy before the first update, in simulation; in a tank, it costs time."""
        recorder, every = self._recorder, self._job.settings.evaluation.every
        if every and self._job.on == "simulation" and recorder.latest is None:
            self._evaluate()
            recorder.log_evaluation()
            recorder.save(due=False)

    def _evaluate(self) -> None:
        """Evaluate the policy without exploration; in a tank, evaluate other candidates, too."""
        if self._job.on == "simulation":
            self._display.evaluated(self._recorder.add(self._in_simulation()))
            return
        recorder, tank = self._recorder, self._tank
        try:
            tank.add(recorder.steps, recorder.rollouts)
            tank.swim(self._job.settings.evaluation.on_robot)
        finally:
            for result in tank.results(recorder.steps):
                self._display.evaluated(recorder.add_measured(result))
            recorder.winner = tank.best

    def _in_simulation(self) -> Evaluation:
        job, env = self._job, self._env
        policy = DeterministicPolicy(self._model.policy, env.perception, env.link.amplitude)
        camera, steps = job.simulated_camera, self._recorder.steps
        result = evaluation.evaluate_in_simulation(
            job.config, policy, job.settings.evaluation, camera
        )
        if job.settings.evaluation.others:
            others = evaluation.worst_on_others(job.config, policy, job.settings, camera)
            result = replace(result, lowest_relative_thrust=min(others, result.relative_thrust))
        return replace(result, steps=steps, policy=steps, tank_time=env.tank_time)


def _enable_cleaning(rollout: Rollout, env: SwimEnv) -> None:
    """Let the rollout remove the errors of the sensor from the measured forces."""
    rollout.signal = ThrustSignal(env.best_thrust)
    rollout.reward_per_newton = env.reward_per_newton


def _format_advice(job: Job) -> str:
    """Return advice for the user after the run folder could not be written."""
    folder = shlex.quote(str(job.folder))
    if checkpoints.list_all(job.folder):
        return f"go on from the newest checkpoint with --resume {folder}"
    robot = " --on live" if job.on == "live" else ""
    return (
        f"remove {job.folder}, which has no checkpoint yet, and start again with 'fishctl learn "
        f"ppo{robot} --folder {folder}' and your other options"
    )
