"""Checkpoints: folders from which a training goes on, or a policy is exported.

`step-005120` was due, or is the last of a run; `best-004096` swam best in an evaluation. In each:
`model.zip` (stable-baselines3: policy, value, optimiser), `card.json` (what a policy file carries)
and `state.json` (counts, evaluations, random numbers). One is written under a temporary name and
renamed: whatever kills the writer, no half a checkpoint is ever taken for a whole one.
"""

import io
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, cast
from zipfile import ZipFile

import msgspec
import numpy as np
import torch
from msgspec import Meta, Struct
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file

from fishd import files
from fishd.errors import FishdError, PolicyError
from fishd.learning.ppo import make_policy
from fishd.learning.settings import TrainingSettings
from fishd.policies.card import Card, decode, encode
from fishd.schema import nested_too_deeply

MODEL, CARD, STATE = "model.zip", "card.json", "state.json"

LARGEST_MODEL = 256 * 2**20
"""Of networks and optimiser [bytes]."""
LARGEST_TEXT = 2**20
"""Of a card, or of a state [bytes]."""

_OTHERWISE = "move this checkpoint away to go on from the one before"


class CheckpointError(FishdError, RuntimeError):
    """There is no checkpoint where one is needed, or a run folder cannot be read or written."""


class Evaluation(Struct, frozen=True):
    """How the policy swam without exploration."""

    steps: int
    """Control steps that it had learned from."""
    tank_time: float
    """Time in the tank until then [s]."""
    thrust: float
    """Mean thrust [N]; on a robot as measured."""
    efficiency: float
    """Over the thrust of the configured fish's best square wave."""
    frequency: float
    """Tail beats per second; 0 where the tail does not beat [Hz]."""
    fullness: float
    """Mean |φ_c|/Φ."""
    stalled: bool
    """It does not swim at all."""
    worst: float | None = None
    """Lowest efficiency on this and on other fish, where others were tried."""

    @property
    def merit(self) -> float:
        """What the best policy is chosen by."""
        return self.efficiency if self.worst is None else self.worst


class State(Struct, frozen=True):
    """What a training must know to go on, beside the networks and their optimiser."""

    on: Literal["simulation", "robot"]
    steps: Annotated[int, Meta(ge=0)]
    updates: int
    """Passes over rollouts so far, as stable-baselines3 counts them."""
    tank_time: float
    """[s]"""
    rollouts: int
    """Updates so far."""
    latest: Evaluation | None
    best: Evaluation | None
    random: dict[str, Any]
    """Of torch, numpy and the environment."""


def save(folder: Path, kind: str, model: PPO, card: Card, state: State) -> Path:
    """Write a checkpoint; kind: step or best, of which only the newest is kept."""
    name = f"{kind}-{state.steps:06d}"
    final, part = folder / name, folder / f".{name}.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    archive = io.BytesIO()  # it leaves a file open where the disk is full
    model.save(archive)
    (part / MODEL).write_bytes(archive.getvalue())
    (part / CARD).write_text(_indented(encode(card)), encoding="utf-8")
    (part / STATE).write_text(json.dumps(msgspec.to_builtins(state)), encoding="utf-8")
    if final.exists():  # a run that was stopped before it learned any more
        _discard(final)
    part.rename(final)
    if kind == "best":
        for other in folder.glob("best-*"):
            if other != final:
                _discard(other)
    return final


def newest(folder: Path) -> Path:
    """The checkpoint with most steps in a run folder; raises `CheckpointError`."""
    return _last(folder, "step-*", "best-*")


def best(folder: Path) -> Path | None:
    """The checkpoint that swam best, where there was an evaluation in which it swam at all."""
    found = sorted(folder.glob("best-*"), key=_steps)
    return found[-1] if found else None


def find(path: Path, *, latest: bool = False) -> Path:
    """The checkpoint that is meant by a run folder, its best where there is one, or by itself.

    latest: the newest of a run rather than its best

    Raises `CheckpointError`.
    """
    if (path / MODEL).is_file():
        return path
    if not path.is_dir():
        what = "is no folder" if path.exists() else "no such folder"
        raise CheckpointError(f"{path}: {what}; the run folder of a training is needed")
    seeds = sorted(path.glob("seed-*"), key=lambda one: (len(one.name), one.name))
    if seeds:
        raise CheckpointError(
            f"{path} holds several trainings, {seeds[0].name} to {seeds[-1].name}; name one of them"
        )
    return (None if latest else best(path)) or newest(path)


def sweep(folder: Path) -> None:
    """Remove what a killed writer left half-written, or half-removed."""
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
        data = json.loads(_text(checkpoint / STATE))  # unlike msgspec, it reads whole numbers whole
        if nested_too_deeply(data):
            raise RecursionError
        return msgspec.convert(data, State)
    except RecursionError:
        raise CheckpointError(f"{checkpoint / STATE}: nested too deeply; {_OTHERWISE}") from None
    except ValueError as error:
        raise CheckpointError(f"{checkpoint / STATE}: {error}; {_OTHERWISE}") from None


def load_parameters(model: PPO, checkpoint: Path, *, optimiser: bool = True) -> None:
    """Put networks, and optimiser, into a model of the same shape; raises `CheckpointError`."""
    fresh = model.get_parameters()["policy.optimizer"]
    with _readable(checkpoint / MODEL) as parameters:
        model.set_parameters(parameters, exact_match=True, device="cpu")
    if not optimiser:
        model.policy.optimizer.load_state_dict(fresh)


def load_policy(checkpoint: Path) -> ActorCriticPolicy:
    """The networks of a checkpoint; raises `CheckpointError`."""
    card = read_card(checkpoint)
    with _readable(checkpoint / MODEL) as parameters:
        settings = msgspec.convert(card.provenance.settings, TrainingSettings)
        policy = make_policy(settings.ppo, len(card.observation))
        policy.load_state_dict(parameters["policy"])
    policy.set_training_mode(False)
    return policy


@contextmanager
def _readable(path: Path) -> Iterator[dict[str, Any]]:
    """The tensors in a model's file, which may be of the wrong shape for those who use them."""
    try:
        yield _tensors(path)
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}; {_OTHERWISE}") from None
    except (RuntimeError, ValueError, KeyError) as error:
        raise CheckpointError(f"{path}: cannot be read: {_brief(error)}; {_OTHERWISE}") from None


def _tensors(path: Path) -> dict[str, Any]:
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


def random_state(generator: np.random.Generator) -> dict[str, Any]:
    """The state of all random numbers of a training, for JSON; generator: the environment's."""
    _, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)
    return {
        "torch": torch.get_rng_state().numpy().tobytes().hex(),
        "numpy": [np.asarray(keys).tolist(), int(position), int(has_gauss), float(gauss)],
        "environment": dict(generator.bit_generator.state),
    }


def restore_random_state(state: dict[str, Any], generator: np.random.Generator) -> None:
    """The reverse of `random_state`; raises `CheckpointError`."""
    try:
        _restore(state, generator)
    except (KeyError, IndexError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f"{STATE}: random: not the state of random numbers: {error}; {_OTHERWISE}"
        ) from None


def _restore(state: dict[str, Any], generator: np.random.Generator) -> None:
    torch.set_rng_state(torch.frombuffer(bytearray.fromhex(state["torch"]), dtype=torch.uint8))
    keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state(("MT19937", np.array(keys, np.uint32), position, has_gauss, gauss))
    generator.bit_generator.state = state["environment"]


def _discard(checkpoint: Path) -> None:
    """Remove a checkpoint; killed in between, it leaves none that looks whole."""
    old = checkpoint.with_name(f".{checkpoint.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    checkpoint.rename(old)
    shutil.rmtree(old)


def _last(folder: Path, *patterns: str) -> Path:
    found = sorted((path for p in patterns for path in folder.glob(p)), key=_steps)
    if not found:
        raise CheckpointError(
            f"{folder}: no checkpoint is in there: its training ended before the first one; remove "
            "it, and train again"
        )
    return found[-1]


def _steps(path: Path) -> tuple[int, bool]:
    number = path.name.partition("-")[2]
    return int(number) if number.isdecimal() else -1, path.name.startswith("step")


def _text(path: Path) -> str:
    try:
        return files.read_text(path, LARGEST_TEXT, "a checkpoint")
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}; {_OTHERWISE}") from None


def _indented(text: str) -> str:
    return msgspec.json.format(text, indent=2) + "\n"
