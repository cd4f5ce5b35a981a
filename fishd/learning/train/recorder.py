"""Output of a training in its run folder: tables, TensorBoard logs, checkpoints."""

import copy
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec.structs import replace
from stable_baselines3 import PPO
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

from fishd.controllers.policy.card import Card
from fishd.core.errors import ConfigError
from fishd.core.files import write_atomically
from fishd.core.process.lockfile import LockHeld, locked
from fishd.lab.experiment import RESULT
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.run_folder import checkpoints, runs
from fishd.learning.run_folder.checkpoints import CheckpointError, State
from fishd.learning.run_folder.runs import make_card
from fishd.learning.run_folder.tables import EVALUATIONS, PROGRESS, Table
from fishd.learning.train.candidates import Candidate
from fishd.learning.train.jobs import Job

MIN_FINAL_MERIT = 0.97
"""Smallest merit with which a training may end before its last step."""
MIN_IMPROVEMENT = 0.001
"""Smallest rise of the merit that counts as a better policy."""
_FIGURES = ("thrust", "relative_thrust", "frequency", "fullness", "is_stalled")
"""Columns of evaluations.csv that are in the TensorBoard log, too."""


class ProgressWriter(KVWriter):
    """A log writer that adds the values of an update as a row to progress.csv."""

    def __init__(self, table: Table) -> None:
        self._table = table

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Write one row."""
        self._table.add({column: key_values.get(key) for column, key in PROGRESS.items()})

    def close(self) -> None:
        """Do nothing: no file is held open."""


class RunRecorder:
    """Recorder of a run: creates or opens its folder, loads initial networks, logs progress."""

    def __init__(self, job: Job, env: SwimEnv, model: PPO) -> None:
        """
        model: receives the networks of the initial checkpoint of the job

        Raises `ConfigError` and `CheckpointError`.
        """
        self._job, self._env, self._model = job, env, model
        self.steps = 0
        """Number of control steps learned from."""
        self.rollouts = 0
        """Number of updates."""
        self.latest: Evaluation | None = None
        self.best: Evaluation | None = None
        self.unimproved = 0
        """Number of evaluations in simulation since the best merit rose by `MIN_IMPROVEMENT`."""
        self._plateau = 0.0
        """Merit of the best policy after its latest rise by `MIN_IMPROVEMENT`."""
        self.imitated = False
        """Whether imitation is finished, in this run or in the one that it began with."""
        self.checkpoint: Path | None = None
        """Newest `step` checkpoint, or the one that the run was resumed from."""
        self.winner: Candidate | None = None
        """Policy of `best`, where it was evaluated in a tank; it may be older than the model."""
        self._kept: Evaluation | None = None
        """Evaluation of the best policy, as stored in its checkpoint."""
        self._note = ""
        with ExitStack() as lock:
            if job.resume:
                self._lock_folder(lock)
                self._resume()
            else:
                if job.parent:
                    self._begin_with(job.parent)
                camera = job.camera if job.simulated_camera and job.on == "simulation" else None
                runs.create(job.folder, job.config, job.settings, camera, job.on, job.command)
                self._lock_folder(lock)
            progress = self._open_table("progress.csv", tuple(PROGRESS))
            self._evaluations = self._open_table(EVALUATIONS, Evaluation.__struct_fields__)
            self._board = TensorBoardOutputFormat(str(job.folder / "tensorboard"))
            model.set_logger(Logger(None, [self._board, ProgressWriter(progress)]))
            self.save()  # from now on, there is always a checkpoint to resume from
            self._lock = lock.pop_all()

    def log(self) -> None:
        """Write the figures of the latest update to progress.csv and to the TensorBoard log."""
        logger = self._model.logger
        logger.record("tank/steps", self.steps)
        logger.record("tank/time", self._env.tank_time)
        for key, value in self._evaluation_figures().items():
            logger.record(key, value)
        logger.dump(self.steps)

    def log_evaluation(self) -> None:
        """Write the latest evaluation to the TensorBoard log, where no update belongs to it."""
        figures = self._evaluation_figures()
        self._board.write(figures, dict.fromkeys(figures, ()), self.steps)

    def _evaluation_figures(self) -> dict[str, float]:
        """Return the figures of the latest evaluation by their keys in TensorBoard."""
        if not (self._job.settings.evaluation.every and self.latest):
            return {}
        return {f"evaluation/{name}": float(getattr(self.latest, name)) for name in _FIGURES}

    def add(self, evaluation: Evaluation) -> Evaluation:
        """Write one row of evaluations.csv; return the evaluation with `best` set."""
        is_best = self.best is None or evaluation.merit >= self.best.merit
        # The additional evaluations at the start must not end a training earlier.
        every = self._job.settings.evaluation.every
        self.unimproved += not every or self.rollouts % every == 0
        if evaluation.merit >= self._plateau + MIN_IMPROVEMENT:
            self._plateau, self.unimproved = evaluation.merit, 0
        return self.add_measured(replace(evaluation, best=is_best and not evaluation.is_stalled))

    @property
    def has_converged(self) -> bool:
        """True if the newest policy is good, and `patience` evaluations showed no better one."""
        patience, latest, best = self._job.settings.evaluation.patience, self.latest, self.best
        if patience is None or latest is None or best is None or self.unimproved < patience:
            return False
        return best.merit >= MIN_FINAL_MERIT and latest.merit > best.merit - MIN_IMPROVEMENT

    def add_measured(self, evaluation: Evaluation) -> Evaluation:
        """Write one row of evaluations.csv, with `best` as given; return the evaluation."""
        self._evaluations.add(msgspec.structs.asdict(evaluation))
        if evaluation.policy == self.steps:
            self.latest = evaluation
        if evaluation.best:
            self.best = evaluation
        return evaluation

    def save(self, *, due: bool = True, policy_changed: bool = False) -> None:
        """Write a `best` checkpoint if another policy is now the best, and a `step` one if due.

        due: write a `step` checkpoint unless the newest one is of this step, and also a `best`
            one if only the figures of the best policy have changed
        policy_changed: write it even then, because the policy has changed without a step

        Call it after the rows of the tables are written: a resume drops rows that are newer than
        the checkpoint, but cannot add missing ones.
        """
        name, best, kept = f"{self.steps:06d}", self.best, self._kept
        is_better = kept is None or (
            best and best.policy != kept.policy and best.merit != kept.merit
        )
        if best and best != kept and (due or is_better):
            with (
                _with_parameters(self._model, self.winner.parameters)
                if self.winner
                else nullcontext()
            ):
                self._save("best")
            self._kept = best
            self._write_result(best)
        if policy_changed or (
            due and (self.checkpoint is None or self.checkpoint.name != f"step-{name}")
        ):
            self.checkpoint = self._save("step")

    def _write_result(self, best: Evaluation) -> None:
        """Write what `fishctl runs` shows of this training."""
        result = {
            "thrust": best.thrust,
            "thrust_ci95": best.thrust_ci95 or 0.0,  # a simulated fish shows its true thrust
            "summary": f"{best.relative_thrust:.1%} of the best square wave, after {best.policy} "
            "steps",
        }
        write_atomically(self._job.folder / RESULT, msgspec.json.encode(result))

    def close(self) -> None:
        """Close the logs and unlock the folder."""
        self._model.logger.close()
        self._lock.close()

    def _lock_folder(self, lock: ExitStack) -> None:
        """Lock the run folder; raises `ConfigError` where another training has locked it."""
        folder = self._job.folder
        try:
            lock.enter_context(locked(folder / "training", remove=True))
        except LockHeld as taken:
            raise ConfigError(f"{folder} is being trained in, by process {taken.pid}") from None

    def _save(self, kind: Literal["step", "best"]) -> Path:
        candidate = self.winner if kind == "best" else None
        state = State(
            on=self._job.on,
            steps=candidate.steps if candidate else self.steps,
            updates=candidate.updates if candidate else self._model._n_updates,
            tank_time=self._env.tank_time,
            rollouts=candidate.rollouts if candidate else self.rollouts,
            latest=self.latest,
            best=self.best,
            imitated=self.imitated,
            swims=self.winner.swims if self.winner else 0,
        )
        card = self._card(state.steps, self.best if kind == "best" else self.latest)
        return checkpoints.save(
            self._job.folder, kind, self._model, card, state, self._env.extractor
        )

    def _card(self, steps: int = 0, evaluation: Evaluation | None = None) -> Card:
        job, seen = self._job, self._env.features
        return make_card(job.config, job.settings, seen, job.on, steps, evaluation, self._note)

    def _begin_with(self, parent: Path) -> None:
        """Load the networks of another run; raises `CheckpointError`."""
        past = self._check_card(parent).provenance
        checkpoints.load_parameters(self._model, parent, optimiser=False)
        name = f"{parent.resolve().parent.name}/{parent.name}"
        self._note = f"began with {name}, {past.steps} steps in {past.on}"
        self.imitated = True

    def _check_card(self, checkpoint: Path) -> Card:
        """Return the card of a checkpoint.

        Raises `CheckpointError` where its inputs, actions or networks differ from those of this
        training.
        """
        card, own = checkpoints.read_card(checkpoint), self._card()
        theirs = _architecture(card.provenance.settings)
        ours = _architecture(own.provenance.settings)
        for key, here in ours.items():
            if theirs.get(key) != here:
                raise CheckpointError(
                    f"{checkpoint}: its {key} is {theirs.get(key)}, that of this training is "
                    f"{here}; feature extractor and networks must be alike"
                )
        for what in ("observation", "history", "tick", "amplitude"):
            here, there = getattr(own, what), getattr(card, what)
            if there != here:
                how = (
                    "observation, or a scale of it, differs from that of this training"
                    if what == "observation"
                    else f"{what} is {there}, that of this training is {here}"
                )
                raise CheckpointError(
                    f"{checkpoint}: its {how}; "
                    "use the configuration and the environment settings that it was trained with"
                )
        return card

    def _load_eye(self, checkpoint: Path) -> None:
        if self._env.extractor:
            checkpoints.load_extractor(self._env.extractor, checkpoint)

    def _resume(self) -> None:
        """Continue from the newest checkpoint; raises `ConfigError` and `CheckpointError`."""
        job, model = self._job, self._model
        checkpoints.remove_partial(job.folder)
        self.checkpoint = checkpoints.newest(job.folder)
        state = checkpoints.read_state(self.checkpoint)
        if state.on != job.on:
            raise ConfigError(
                f"{job.folder} was trained on {state.on}; to go on with its networks on another "
                f"fish, begin a new run: --on {job.on} --fine-tune {job.folder}"
            )
        card = self._check_card(self.checkpoint)
        if state.is_finished(job.settings.steps):
            raise ConfigError(
                f"{job.folder} is finished, with {state.steps} steps; to train it for longer, give "
                f"a larger total, such as --steps {state.steps + job.settings.steps}"
            )
        checkpoints.load_parameters(model, self.checkpoint)
        self._load_eye(self.checkpoint)
        self._note = card.provenance.note
        self.steps = model.num_timesteps = state.steps
        self.rollouts, model._n_updates = state.rollouts, state.updates
        self.latest, self.imitated = state.latest, state.imitated
        self._restore_best(state)
        self._env.tank_time = state.tank_time
        runs.write_settings(job.folder, job.settings)

    def _restore_best(self, state: State) -> None:
        """Restore the best policy; one from a tank stays a candidate, with its previous swims.

        After a kill, the checkpoint of the best may be newer than the one that is resumed.
        """
        path = checkpoints.best(self._job.folder) if state.on == "live" else None
        past = checkpoints.read_state(path) if path else state
        best = self._kept = self.best = past.best
        self._plateau = best.merit if best else 0.0
        if path and best:
            self.winner = Candidate(
                steps=past.steps,
                updates=past.updates,
                rollouts=past.rollouts,
                parameters=checkpoints.read_parameters(path),
                swims=past.swims,
                thrust=best.thrust if past.swims else 0.0,
                swim_time=best.swim_time or 0.0,
                frequency=best.frequency,
                fullness=best.fullness,
            )
        elif state.on == "live":  # its checkpoint was moved away
            self._kept = self.best = None

    def _open_table(self, name: str, columns: tuple[str, ...]) -> Table:
        table = Table(self._job.folder / name, columns)
        if self._job.resume:
            # The first checkpoint is older than the evaluation of the untrained policy.
            table.keep_until(self.steps if self.steps or self.latest else -1)
        return table


@contextmanager
def _with_parameters(model: PPO, parameters: dict[str, Any]) -> Iterator[None]:
    """Give a model other networks and another optimiser state; restore its own at the end."""
    own: Any = copy.deepcopy(model.get_parameters())
    model.set_parameters(parameters, device="cpu")
    try:
        yield
    finally:
        model.set_parameters(own, device="cpu")


def _architecture(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings that determine the architecture of the networks, by key."""
    settings = msgspec.json.decode(msgspec.json.encode(settings))  # lists, as in a file
    see, ppo = settings.get("see", "force"), settings.get("ppo", {})
    camera = {} if see == "force" else settings.get("camera", {})
    return {
        "see": see,
        **{f"ppo.{key}": ppo.get(key) for key in ("hidden", "activation", "symmetric")},
        **{f"camera.{key}": value for key, value in camera.items()},
    }
