"""Checkpoints: folders from which a training is resumed, or a policy is exported.

`step-005120` was due, or is the last of a run; `best-004096` swam best in an evaluation. In each:
`model.zip` (stable-baselines3: policy, value, optimiser), `card.json` (what a policy file carries)
and `state.json` (counts and evaluations). Each is written under a temporary name and then renamed:
whatever kills the writer, half a checkpoint is never used.
"""

import io
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast
from zipfile import ZipFile

import msgspec
import numpy as np
from msgspec import Meta, Struct

from fishd.controllers.policy.card import Card, decode, encode
from fishd.core import files
from fishd.core.errors import FishdError, PolicyError
from fishd.lab.experiment import On
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.env.perception import Perception
from fishd.learning.eyes import making as eyes
from fishd.learning.eyes.base import Eye
from fishd.learning.settings import TrainingSettings

# What brings torch is imported where it is used: most of this is asked for without any networks.
if TYPE_CHECKING:
    from stable_baselines3 import PPO
    from stable_baselines3.common.policies import ActorCriticPolicy

MODEL, CARD, STATE, EYE = "model.zip", "card.json", "state.json", "eye.msgpack"

LARGEST_MODEL = 256 * 2**20
"""Of networks and optimiser [bytes]."""
LARGEST_EYE = 16 * 2**20
"""Of what an eye has learned to see [bytes]."""
LARGEST_TEXT = 2**20
"""Of a card, or of a state [bytes]."""

_NAME = re.compile(r"(step|best)-(\d+)", re.ASCII)
_ADVICE = "move this checkpoint away to resume from the previous one"


class CheckpointError(FishdError, RuntimeError):
    """There is no checkpoint where one is needed, or a run folder cannot be read or written."""


class State(Struct, frozen=True):
    """What is needed to resume a training, besides the networks and their optimiser."""

    on: On
    steps: Annotated[int, Meta(ge=0)]
    """Control steps that were learned from."""
    updates: int
    """Passes over rollouts so far, as stable-baselines3 counts them."""
    tank_time: float
    """[s]"""
    rollouts: int
    """Updates so far."""
    latest: Evaluation | None
    best: Evaluation | None
    imitated: bool = False
    """Has it learned by imitation what it was to, itself or in the run that it began with?"""
    swims: int = 0
    """How often the best was measured in a tank."""

    def is_finished(self, steps: int) -> bool:
        """Has a training of so many steps nothing left to do?"""
        return self.steps >= steps and (self.steps > 0 or self.imitated)


class Constant(Struct, frozen=True):
    """A constant of an eye."""

    shape: tuple[Annotated[int, Meta(ge=0)], ...]
    values: bytes
    """As float32, row by row."""


def save(
    folder: Path, kind: str, model: "PPO", card: Card, state: State, eye: Eye | None = None
) -> Path:
    """Write a checkpoint; kind: step or best, of which only the newest is kept."""
    name = f"{kind}-{state.steps:06d}"
    final, part = folder / name, folder / f".{name}.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    archive = io.BytesIO()  # given a path, it leaves a file open where the disk is full
    model.save(archive)
    files.write_atomically(part / MODEL, archive.getvalue())
    files.write_atomically(part / CARD, msgspec.json.format(encode(card), indent=2) + "\n")
    files.write_atomically(part / STATE, msgspec.json.encode(state))
    if eye and eye.is_fitted:
        constants = {name: Constant(a.shape, a.tobytes()) for name, a in eye.constants.items()}
        files.write_atomically(part / EYE, msgspec.msgpack.encode(constants))
    files.sync_folder(part)
    if final.exists():  # a run that was stopped before it learned any more
        replaced = folder / f".{name}.replaced"
        final.rename(replaced)
        part.rename(final)
        files.sync_folder(folder)
        _discard(replaced)
    else:
        part.rename(final)
        files.sync_folder(folder)
    if kind == "best":
        for other in folder.glob("best-*"):
            if other != final:
                _discard(other)
    return final


def all_in(folder: Path) -> list[Path]:
    """The checkpoints of a run, by their steps; a `best` comes before a `step` of the same."""
    named = [(_NAME.fullmatch(path.name), path) for path in folder.glob("*-*")]
    found = [(int(name[2]), name[1] == "step", path) for name, path in named if name]
    return [path for _, _, path in sorted(found)]


def newest(folder: Path) -> Path:
    """The checkpoint with most steps in a run folder; raises `CheckpointError`."""
    found = all_in(folder)
    if not found:
        raise CheckpointError(
            f"{folder}: there is no checkpoint in it: the training ended before the first one, or "
            "there was none; name another folder, or train into a new one"
        )
    return found[-1]


def best(folder: Path) -> Path | None:
    """The checkpoint that swam best; None where no policy of the run has swum."""
    found = [path for path in all_in(folder) if path.name.startswith("best")]
    return max(found, key=_written, default=None)  # a kill may have left the one before


def find(path: Path, *, latest: bool = False) -> Path:
    """The checkpoint at `path`, or in the run folder there: its best, else its newest.

    latest: the newest of a run rather than its best

    Raises `CheckpointError`.
    """
    if (path / MODEL).is_file():
        return path
    if not path.is_dir():
        what = "not a folder" if path.exists() else "no such folder"
        raise CheckpointError(f"{path}: {what}; the run folder of a training is needed")
    refuse_several(path)
    return (None if latest else best(path)) or newest(path)


def refuse_several(folder: Path) -> None:
    """Raises `CheckpointError` where each seed has a run folder of its own in this one."""
    seeds = sorted(folder.glob("seed-*"), key=lambda one: (len(one.name), one.name))
    if seeds:
        raise CheckpointError(
            f"{folder} holds several trainings, {seeds[0].name} to {seeds[-1].name}; name one of "
            "them"
        )


def sweep(folder: Path) -> None:
    """Remove what a killed writer left half-written, or half-removed; nothing whole is lost."""
    for replaced in folder.glob(".*.replaced"):
        final = folder / replaced.name.removeprefix(".").removesuffix(".replaced")
        if final.exists():
            shutil.rmtree(replaced)
        else:
            replaced.rename(final)
    for left in (*folder.glob(".*.part"), *folder.glob(".*.old")):
        if left.is_dir():
            shutil.rmtree(left)
        else:
            left.unlink()


def read_card(checkpoint: Path) -> Card:
    """Raises `CheckpointError`."""
    try:
        return decode(_text(checkpoint / CARD))
    except PolicyError as error:
        raise CheckpointError(f"{checkpoint / CARD}: {error}") from None


def read_state(checkpoint: Path) -> State:
    """Raises `CheckpointError`."""
    try:
        return msgspec.json.decode(_text(checkpoint / STATE), type=State)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{checkpoint / STATE}: {_brief(error)}; {_ADVICE}") from None


def load_parameters(model: "PPO", checkpoint: Path, *, optimiser: bool = True) -> None:
    """Load networks, and optimiser, into a model of the same shape; raises `CheckpointError`."""
    fresh = model.get_parameters()["policy.optimizer"]
    with _readable(checkpoint / MODEL) as parameters:
        model.set_parameters(parameters, exact_match=True, device="cpu")
    if not optimiser:
        model.policy.optimizer.load_state_dict(fresh)


def read_parameters(checkpoint: Path) -> dict[str, Any]:
    """Those of networks and optimiser; raises `CheckpointError`."""
    with _readable(checkpoint / MODEL) as parameters:
        return parameters


def load_policy(checkpoint: Path) -> tuple["ActorCriticPolicy", Perception]:
    """The networks of a checkpoint, and what they are given; raises `CheckpointError`."""
    from fishd.learning.ppo import make_policy

    card = read_card(checkpoint)
    settings = msgspec.convert(card.provenance.settings, TrainingSettings)
    eye = eyes.make(settings)
    if eye:
        load_eye(eye, checkpoint)
    with _readable(checkpoint / MODEL) as parameters:
        policy = make_policy(settings.ppo, card.numbers, eye)
        policy.load_state_dict(parameters["policy"])
    policy.set_training_mode(False)
    return policy, Perception(card.observation, eye, card.window)


def load_eye(eye: Eye, checkpoint: Path) -> None:
    """Give an eye the constants of a checkpoint, if it had any; raises `CheckpointError`."""
    path = checkpoint / EYE
    if not path.exists():
        return
    try:
        content = files.read(path, LARGEST_EYE, "the constants of an eye")
        found = msgspec.msgpack.decode(content, type=dict[str, Constant])
        eye.restore(
            {
                name: np.frombuffer(one.values, np.float32).reshape(one.shape)
                for name, one in found.items()
            }
        )
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}; {_ADVICE}") from None
    except (ValueError, OverflowError, RecursionError) as error:
        raise CheckpointError(f"{path}: cannot be read: {_brief(error)}; {_ADVICE}") from None


@contextmanager
def _readable(path: Path) -> Iterator[dict[str, Any]]:
    """The tensors in a model's file; those who use them may find that their shapes are wrong."""
    try:
        yield _tensors(path)
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}; {_ADVICE}") from None
    except (RuntimeError, ValueError, KeyError) as error:
        raise CheckpointError(f"{path}: cannot be read: {_brief(error)}; {_ADVICE}") from None


def _tensors(path: Path) -> dict[str, Any]:
    from stable_baselines3.common.save_util import load_from_zip_file

    content = files.read(path, LARGEST_MODEL, "a checkpoint")
    try:
        with ZipFile(io.BytesIO(content)) as archive:
            if sum(part.file_size for part in archive.infolist()) > LARGEST_MODEL:
                raise ValueError("it unpacks to far more than a checkpoint needs")
        found = load_from_zip_file(io.BytesIO(content), load_data=False, device="cpu")
        return cast(dict[str, Any], found[1])
    except Exception as error:  # a damaged archive contradicts itself in many ways
        raise ValueError(_brief(error.__cause__ or error)) from None


def _brief(error: BaseException) -> str:
    if isinstance(error, KeyError):
        return f"{error} is missing"
    return " ".join(str(error).split())[:200] or type(error).__name__


def _discard(checkpoint: Path) -> None:
    """Remove a checkpoint; killed in between, it leaves none that looks complete."""
    old = checkpoint.with_name(f".{checkpoint.name.removeprefix('.')}.old")
    shutil.rmtree(old, ignore_errors=True)
    checkpoint.rename(old)
    shutil.rmtree(old)


def _written(checkpoint: Path) -> float:
    try:
        return (checkpoint / STATE).stat().st_mtime
    except OSError:
        return 0.0


def _text(path: Path) -> str:
    try:
        return files.read_text(path, LARGEST_TEXT, "a checkpoint")
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}; {_ADVICE}") from None
