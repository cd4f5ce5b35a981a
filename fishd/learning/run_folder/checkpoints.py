"""Checkpoints: folders from which a training is resumed, or a policy is exported.

`step-005120` was due, or is the last of a run; `best-004096` swam best in an evaluation. Files:
`model.zip` (stable-baselines3: policy, value, optimiser), `card.json` (the card of a policy file)
and `state.json` (counts and evaluations). A checkpoint is written under a temporary name and then
renamed: half a checkpoint is never used, whatever kills the writer.
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
from fishd.learning import extractors
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.env.perception import Perception
from fishd.learning.extractors import FeatureExtractor
from fishd.learning.settings import from_plain

# Modules that import torch are imported where they are used: most functions need no networks.
if TYPE_CHECKING:
    from stable_baselines3 import PPO
    from stable_baselines3.common.policies import ActorCriticPolicy

MODEL, CARD, STATE, EYE = "model.zip", "card.json", "state.json", "eye.msgpack"

MAX_MODEL_BYTES = 256 * 2**20
"""Largest size of the file of networks and optimiser [bytes]."""
MAX_EXTRACTOR_BYTES = 16 * 2**20
"""Largest size of the file of a feature extractor's constants [bytes]."""
MAX_TEXT_BYTES = 2**20
"""Largest size of the file of a card, or of a state [bytes]."""

_NAME = re.compile(r"(step|best)-(\d+)", re.ASCII)
_ADVICE = "move this checkpoint away to resume from the previous one"


class CheckpointError(FishdError, RuntimeError):
    """Error of a missing checkpoint, or of a run folder that cannot be read or written."""


class State(Struct, frozen=True):
    """The state that resumes a training, besides the networks and their optimiser."""

    on: On
    steps: Annotated[int, Meta(ge=0)]
    """Number of control steps learned from."""
    updates: int
    """Number of passes over rollouts, as stable-baselines3 counts them."""
    tank_time: float
    """Time in the tank [s]."""
    rollouts: int
    """Number of updates."""
    latest: Evaluation | None
    best: Evaluation | None
    imitated: bool = False
    """Whether imitation is finished, in this run or in the one that it began with."""
    swims: int = 0
    """Number of measured swims of the best policy in a tank."""
    number: int = 0
    """Running number of a `best` checkpoint in its run, which grows with each."""

    def is_finished(self, steps: int) -> bool:
        """Return True if a training of `steps` control steps is complete."""
        return self.steps >= steps and (self.steps > 0 or self.imitated)


class Constant(Struct, frozen=True):
    """A constant of a feature extractor."""

    shape: tuple[Annotated[int, Meta(ge=0)], ...]
    values: bytes
    """Elements as float32, row by row."""


def save(
    folder: Path,
    kind: str,
    model: "PPO",
    card: Card,
    state: State,
    extractor: FeatureExtractor | None = None,
) -> Path:
    """Write a checkpoint; kind: step or best, of which only the newest is kept."""
    if kind == "best":
        number = 1 + max(map(_read_number, folder.glob("best-*")), default=0)
        state = msgspec.structs.replace(state, number=number)
    name = f"{kind}-{state.steps:06d}"
    final, part = folder / name, folder / f".{name}.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    archive = io.BytesIO()  # given a path, it leaves a file open where the disk is full
    model.save(archive)
    files.write_atomically(part / MODEL, archive.getvalue())
    files.write_atomically(part / CARD, msgspec.json.format(encode(card), indent=2) + "\n")
    files.write_atomically(part / STATE, msgspec.json.encode(state))
    if extractor and extractor.is_fitted:
        constants = {
            name: Constant(a.shape, a.tobytes()) for name, a in extractor.constants.items()
        }
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


def list_all(folder: Path) -> list[Path]:
    """Return the checkpoints of a run by steps; a `best` is before a `step` of the same steps."""
    named = [(_NAME.fullmatch(path.name), path) for path in folder.glob("*-*")]
    checkpoints = [(int(name[2]), name[1] == "step", path) for name, path in named if name]
    return [path for _, _, path in sorted(checkpoints)]


def newest(folder: Path) -> Path:
    """Return the checkpoint with most steps of a run folder; raises `CheckpointError`."""
    checkpoints = list_all(folder)
    if not checkpoints:
        raise CheckpointError(
            f"{folder}: it contains no checkpoint: the training ended before the first one, or "
            "there was none; name another folder, or train into a new one"
        )
    return checkpoints[-1]


def best(folder: Path) -> Path | None:
    """Return the checkpoint that swam best; None where no policy of the run has swum."""
    checkpoints = [path for path in list_all(folder) if path.name.startswith("best")]
    # After a kill, the previous best may remain; the later one may have fewer steps.
    return max(checkpoints, key=_read_number, default=None)


def find(path: Path, *, latest: bool = False) -> Path:
    """Return the checkpoint at `path`, or of the run folder there: its best, else its newest.

    latest: return the newest of a run instead of its best

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
    """Raise `CheckpointError` for a folder that contains the run folders of several seeds."""
    seeds = sorted(folder.glob("seed-*"), key=lambda path: (len(path.name), path.name))
    if seeds:
        raise CheckpointError(
            f"{folder} holds several trainings, {seeds[0].name} to {seeds[-1].name}; name one of "
            "them"
        )


def remove_partial(folder: Path) -> None:
    """Remove half-written and half-removed files of a killed writer; nothing complete is lost."""
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
    """Read the card of a checkpoint; raises `CheckpointError`."""
    try:
        return decode(_read_text(checkpoint / CARD))
    except PolicyError as error:
        raise CheckpointError(f"{checkpoint / CARD}: {error}; {_ADVICE}") from None


def read_state(checkpoint: Path) -> State:
    """Read the state of a checkpoint; raises `CheckpointError`."""
    try:
        return msgspec.json.decode(_read_text(checkpoint / STATE), type=State)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{checkpoint / STATE}: {_format_error(error)}; {_ADVICE}") from None


def load_parameters(model: "PPO", checkpoint: Path, *, optimiser: bool = True) -> None:
    """Load networks, and optimiser, into a model of the same shape; raises `CheckpointError`."""
    fresh = model.get_parameters()["policy.optimizer"]
    with _open_model(checkpoint / MODEL) as parameters:
        model.set_parameters(parameters, exact_match=True, device="cpu")
    if not optimiser:
        model.policy.optimizer.load_state_dict(fresh)


def read_parameters(checkpoint: Path) -> dict[str, Any]:
    """Read the parameters of networks and optimiser; raises `CheckpointError`."""
    with _open_model(checkpoint / MODEL) as parameters:
        return parameters


def load_policy(checkpoint: Path) -> tuple["ActorCriticPolicy", Perception]:
    """Return the networks of a checkpoint, and their perception; raises `CheckpointError`."""
    from fishd.learning.ppo import even_inputs, make_policy

    card = read_card(checkpoint)
    settings = from_plain(card.provenance.settings)
    extractor = extractors.make_extractor(settings)
    if extractor:
        load_extractor(extractor, checkpoint)
    with _open_model(checkpoint / MODEL) as parameters:
        policy = make_policy(settings.ppo, card.numbers, extractor, even_inputs(settings))
        policy.load_state_dict(parameters["policy"])
    policy.set_training_mode(False)
    return policy, Perception(card.observation, extractor, card.window)


def load_extractor(extractor: FeatureExtractor, checkpoint: Path) -> None:
    """Load the constants of a checkpoint into an extractor, if any; raises `CheckpointError`."""
    path = checkpoint / EYE
    if not path.exists():
        return
    try:
        content = files.read(path, MAX_EXTRACTOR_BYTES, "the constants of a feature extractor")
        constants = msgspec.msgpack.decode(content, type=dict[str, Constant])
        extractor.restore(
            {
                name: np.frombuffer(constant.values, np.float32).reshape(constant.shape)
                for name, constant in constants.items()
            }
        )
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}; {_ADVICE}") from None
    except (ValueError, OverflowError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: cannot be read: {_format_error(error)}; {_ADVICE}"
        ) from None


@contextmanager
def _open_model(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the tensors of a model's file; raises `CheckpointError`, also if their use fails."""
    try:
        yield _read_tensors(path)
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}; {_ADVICE}") from None
    except (RuntimeError, ValueError, KeyError) as error:
        raise CheckpointError(
            f"{path}: cannot be read: {_format_error(error)}; {_ADVICE}"
        ) from None


def _read_tensors(path: Path) -> dict[str, Any]:
    from stable_baselines3.common.save_util import load_from_zip_file

    content = files.read(path, MAX_MODEL_BYTES, "a checkpoint")
    try:
        with ZipFile(io.BytesIO(content)) as archive:
            if sum(part.file_size for part in archive.infolist()) > MAX_MODEL_BYTES:
                raise ValueError("it unpacks to far more than a checkpoint needs")
        parts = load_from_zip_file(io.BytesIO(content), load_data=False, device="cpu")
        return cast(dict[str, Any], parts[1])
    except Exception as error:  # a damaged archive raises many kinds of exceptions
        raise ValueError(_format_error(error.__cause__ or error)) from None


def _format_error(error: BaseException) -> str:
    if isinstance(error, KeyError):
        return f"{error} is missing"
    return " ".join(str(error).split())[:200] or type(error).__name__


def _discard(checkpoint: Path) -> None:
    """Remove a checkpoint; if killed midway, it leaves nothing that looks complete."""
    old = checkpoint.with_name(f".{checkpoint.name.removeprefix('.')}.old")
    shutil.rmtree(old, ignore_errors=True)
    checkpoint.rename(old)
    shutil.rmtree(old)


def _read_number(checkpoint: Path) -> int:
    try:
        return read_state(checkpoint).number
    except CheckpointError:
        return 0


def _read_text(path: Path) -> str:
    try:
        return files.read_text(path, MAX_TEXT_BYTES, "a checkpoint")
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}; {_ADVICE}") from None
