"""What a training leaves in its run folder: tables, TensorBoard logs, checkpoints."""

from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import msgspec
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from fishd.errors import ConfigError
from fishd.learning import checkpoints, runs
from fishd.learning.callbacks import Figures
from fishd.learning.checkpoints import CheckpointError, Evaluation, State
from fishd.learning.environment import SwimEnv
from fishd.learning.jobs import Job
from fishd.learning.provenance import make_card
from fishd.learning.tables import Progress, Table
from fishd.lockfile import Taken, locked
from fishd.policies.card import Card


class Keeper:
    """Counts what is done, and keeps it on disk."""

    def __init__(self, job: Job, env: SwimEnv, model: PPO, yardstick: float) -> None:
        """
        model: takes over the networks of the checkpoint that the job begins with
        yardstick: thrust of the best square wave [N]

        Raises `ConfigError` and `CheckpointError`.
        """
        self._job, self._env, self._model, self._yardstick = job, env, model, yardstick
        self.steps = 0
        """Control steps that were learned from."""
        self.rollouts = 0
        """Updates."""
        self.latest: Evaluation | None = None
        self.best: Evaluation | None = None
        self.checkpoint: Path | None = None
        """The newest, but for those of best evaluations."""
        self.resumed: State | None = None
        """Where a resumed run goes on."""
        self._best_kept = -1
        self._note = ""
        with ExitStack() as lock:
            if job.resume:
                self._lock_folder(lock)
                self.checkpoint = checkpoints.newest(job.folder)
                self.resumed = checkpoints.read_state(self.checkpoint)
                self._go_on(self.checkpoint, self.resumed)
            elif job.parent:
                self._begin_with(job.parent)
            self._open(self.resumed, lock)
            self.keep()  # whatever happens from now on, there is something to resume
            self._lock = lock.pop_all()

    def log(self, figures: Figures) -> None:
        """One row about the latest rollout and update."""
        logger, settings = self._model.logger, self._job.settings
        for name, value in (
            ("tank/steps", self.steps),
            ("tank/time", self._env.tank_time),
            ("tank/lost", figures.lost),
            ("tank/paused", figures.paused),
            ("rollout/reward", figures.reward),
            ("rollout/thrust", figures.thrust),
            ("rollout/efficiency", figures.thrust / self._yardstick),
            ("rollout/frequency", figures.frequency),
            ("rollout/fullness", figures.fullness),
        ):
            logger.record(name, value)
        if settings.evaluation.every and self.latest:
            for name in ("thrust", "efficiency", "frequency", "fullness", "stalled"):
                logger.record(f"evaluation/{name}", float(getattr(self.latest, name)))
        logger.dump(self.steps)

    def evaluated(self, evaluation: Evaluation) -> bool:
        """One row about a deterministic evaluation; was it the best so far?

        Then `keep` writes a checkpoint of it.
        """
        self.latest = evaluation
        best = not evaluation.stalled and (self.best is None or evaluation.merit >= self.best.merit)
        self._evaluations.add(msgspec.structs.asdict(evaluation) | {"best": best})
        if best:
            self.best = evaluation
        return best

    def keep(self, *, due: bool = True) -> None:
        """Write a checkpoint where the policy is the best so far.

        due: write one in any case, if the newest is not of this step

        After the rows of the tables: those that are newer than the newest checkpoint are dropped
        when a run is resumed, but none is ever made up for.
        """
        if self.best and self.best.steps == self.steps and self._best_kept != self.steps:
            self._save("best")
            self._best_kept = self.steps
        if not due:
            return
        if self.checkpoint is None or self.checkpoint.name != f"step-{self.steps:06d}":
            self.checkpoint = self._save("step")

    def close(self) -> None:
        """Close the logs, and leave the folder to others."""
        self._model.logger.close()
        self._lock.close()

    def _lock_folder(self, lock: ExitStack) -> None:
        """Keep other trainings out; raises `ConfigError` where there is one."""
        folder = self._job.folder
        try:
            lock.enter_context(locked(folder / "training", remove=True))
        except Taken as taken:
            raise ConfigError(f"{folder} is being trained in, by process {taken.pid}") from None

    def _save(self, kind: Literal["step", "best"]) -> Path:
        state = State(
            on=self._job.on,
            steps=self.steps,
            updates=self._model._n_updates,
            tank_time=self._env.tank_time,
            rollouts=self.rollouts,
            latest=self.latest,
            best=self.best,
            random=checkpoints.random_state(self._env.np_random),
        )
        return checkpoints.save(self._job.folder, kind, self._model, self._card(), state)

    def _card(self) -> Card:
        job = self._job
        return make_card(
            job.config,
            job.settings,
            self._env.features,
            job.on,
            self.steps,
            self.latest,
            self._note,
        )

    def _begin_with(self, parent: Path) -> None:
        card = self._check_same(parent)
        checkpoints.load_parameters(self._model, parent, optimiser=False)
        past = card.provenance
        self._note = (
            f"began with {parent.resolve().parent.name}/{parent.name}, {past.steps} steps in "
            f"{past.on}"
        )

    def _check_same(self, start: Path) -> Card:
        """The card of a checkpoint that sees and does what this training does.

        Raises `CheckpointError`.
        """
        card, own = checkpoints.read_card(start), self._card()
        for what in ("observation", "tick", "amplitude"):
            if getattr(card, what) != getattr(own, what):
                raise CheckpointError(
                    f"{start}: its {what}, with scales, differs from that of this training; use "
                    "the configuration and the environment settings that it was trained with"
                )
        theirs = card.provenance.settings.get("ppo", {})
        ours = msgspec.json.decode(msgspec.json.encode(self._job.settings.ppo))  # lists, as theirs
        for key in ("hidden", "activation", "symmetric"):
            if theirs.get(key) != ours.get(key):
                raise CheckpointError(
                    f"{start}: its ppo.{key} is {theirs.get(key)}, that of this training is "
                    f"{ours.get(key)}; the networks must be alike"
                )
        return card

    def _go_on(self, start: Path, state: State) -> None:
        job = self._job
        if state.on != job.on:
            raise ConfigError(
                f"{job.folder} was trained on {state.on}; to go on with its networks on another "
                f"fish, begin a new run: --on {job.on} --from {job.folder}"
            )
        card = self._check_same(start)
        if state.steps >= job.settings.steps:
            raise ConfigError(
                f"{job.folder} is finished, with {state.steps} steps; to train it for longer, give "
                f"more in all, such as --steps {state.steps + job.settings.steps}"
            )
        checkpoints.load_parameters(self._model, start)
        self._note = card.provenance.note
        self.steps = self._model.num_timesteps = state.steps
        self._model._n_updates = state.updates
        self.rollouts = state.rollouts
        self.latest, self.best = state.latest, state.best
        self._best_kept = state.best.steps if state.best else -1
        self._env.tank_time = state.tank_time

    def _open(self, resumed: State | None, lock: ExitStack) -> None:
        folder = self._job.folder
        if resumed is None:
            runs.create(folder, self._job.config, self._job.settings)
            self._lock_folder(lock)
        else:
            checkpoints.sweep(folder)
            runs.keep_settings(folder, self._job.settings)
        progress = Progress(folder / "progress.csv")
        columns = (*Evaluation.__struct_fields__, "best")
        self._evaluations = Table(folder / "evaluations.csv", columns)
        if resumed:
            progress.table.keep_until(resumed.steps)
            self._evaluations.keep_until(resumed.steps)
        board = TensorBoardOutputFormat(str(folder / "tensorboard"))
        self._model.set_logger(Logger(None, [board, progress]))
