"""What a training leaves in its run folder: tables, TensorBoard logs, checkpoints."""

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
        self.checkpoint = checkpoints.newest(job.folder) if job.resume else None
        """The newest, but for those of best evaluations."""
        self.resumed: State | None = None
        """Where a resumed run goes on."""
        self._note = ""
        if self.checkpoint:
            self.resumed = checkpoints.read_state(self.checkpoint)
            self._go_on(self.checkpoint, self.resumed)
        elif job.parent:
            self._begin_with(job.parent)
        self._open(self.resumed)
        self.keep()  # whatever happens from now on, there is something to resume

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
        """One row about a deterministic evaluation; was it the best so far? Then it is kept."""
        self.latest = evaluation
        best = not evaluation.stalled and (self.best is None or evaluation.merit >= self.best.merit)
        self._evaluations.add(msgspec.structs.asdict(evaluation) | {"best": best})
        if best:
            self.best = evaluation
            self._save("best")
        return best

    def keep(self) -> None:
        """Write a checkpoint, if the newest is not of this step."""
        if self.checkpoint is None or self.checkpoint.name != f"step-{self.steps:06d}":
            self.checkpoint = self._save("step")

    def close(self) -> None:
        """Close the logs."""
        self._model.logger.close()

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
        card, own = checkpoints.read_card(parent), self._card()
        for what in ("observation", "tick", "amplitude"):
            if getattr(card, what) != getattr(own, what):
                raise CheckpointError(
                    f"{parent}: its {what}, with scales, differs from that of this training; use "
                    "the configuration and the environment settings that it was trained with"
                )
        checkpoints.load_parameters(self._model, parent, optimiser=False)
        past = card.provenance
        self._note = (
            f"began with {parent.resolve().parent.name}/{parent.name}, {past.steps} steps in "
            f"{past.on}"
        )

    def _go_on(self, start: Path, state: State) -> None:
        job = self._job
        if state.on != job.on:
            raise ConfigError(
                f"{job.folder} was trained on {state.on}; to go on with its networks on another "
                f"fish, begin a new run: --on {job.on} --from {job.folder}"
            )
        if state.steps >= job.settings.steps:
            raise ConfigError(
                f"{job.folder} is finished, with {state.steps} steps; to train it for longer, give "
                f"more in all, such as --steps {state.steps + job.settings.steps}"
            )
        checkpoints.load_parameters(self._model, start)
        self._note = checkpoints.read_card(start).provenance.note
        self.steps = self._model.num_timesteps = state.steps
        self._model._n_updates = state.updates
        self.rollouts = state.rollouts
        self.latest, self.best = state.latest, state.best
        self._env.tank_time = state.tank_time

    def _open(self, resumed: State | None) -> None:
        folder = self._job.folder
        if resumed is None:
            runs.create(folder, self._job.config, self._job.settings)
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
