"""Checkpoints: all that a swim needs to go on later, in one NPZ file.

Body, water, time, track and command go on to the last bit. The controller is not in it: it begins
anew, from the present command.
"""

import io
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fishd.core import files
from fishd.core.errors import FishdError
from fishd.swimmer.grid import Array
from fishd.swimmer.robot import Swimmer
from fishd.swimmer.track import COLUMNS, Track

FORMAT = 1
LONGEST = 2**30
"""Of a file [bytes]."""
_STATE = "state."


class CheckpointError(FishdError):
    """A file is no checkpoint, or not one of this fish."""


class Checkpoint(NamedTuple):
    """What a file holds."""

    path: Path
    settings: dict[str, Any]
    """Everything that the motion depends on, as in the configuration."""
    controller: str
    parameters: dict[str, Any]
    state: dict[str, Array]
    track: Array
    """The rows so far, of shape (ticks, columns)."""

    @property
    def time(self) -> float:
        """Of the fish [s]."""
        return float(self.state["steps"]) * float(self.settings["swimmer"]["numerics"]["step"])

    def check(self, settings: Mapping[str, Any]) -> None:
        """Raises `CheckpointError` where it is of a fish with other settings than these."""
        here, there = dict(_flat(settings)), dict(_flat(self.settings))
        for key in here | there:
            if here.get(key) != there.get(key):
                raise CheckpointError(
                    f"{self.path}: it is of a swim with {key} {_spelled(there.get(key))}, and here "
                    f"it is {_spelled(here.get(key))}; the same is needed"
                )

    def put_into(self, swimmer: Swimmer) -> None:
        """Let the fish go on from here; raises `CheckpointError`."""
        try:
            swimmer.restore(self.state)
        except (KeyError, ValueError) as error:
            raise CheckpointError(
                f"{self.path}: it is of another version of fishd, and does not fit ({error})"
            ) from None


def save(
    path: Path,
    swimmer: Swimmer,
    track: Track,
    settings: Mapping[str, Any],
    controller: str,
    parameters: Mapping[str, Any],
) -> None:
    """Write a checkpoint; a kill meanwhile leaves the one before. Raises OSError."""
    about = {
        "format": FORMAT,
        "settings": settings,
        "controller": controller,
        "parameters": parameters,
    }
    content = io.BytesIO()
    arrays: dict[str, Any] = {_STATE + name: array for name, array in swimmer.state().items()}
    about_text = np.array(msgspec.json.encode(about).decode())
    np.savez(content, about=about_text, track=track.rows(), **arrays)
    files.write_atomically(path, content.getvalue())


def load(path: Path) -> Checkpoint:
    """Read a checkpoint; raises `CheckpointError`."""
    try:
        content = files.read(path, LONGEST, "a checkpoint")
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}") from None
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        about = msgspec.json.decode(str(arrays.pop("about")))
        if about["format"] != FORMAT:
            raise CheckpointError(
                f"{path}: it is a checkpoint of format {about['format']}, and this fishd reads "
                f"format {FORMAT}"
            )
        track = arrays.pop("track")
        if track.ndim != 2 or track.shape[1] != len(COLUMNS):
            raise ValueError("track")
        return Checkpoint(
            path=path,
            settings=about["settings"],
            controller=about["controller"],
            parameters=about["parameters"],
            state={name.removeprefix(_STATE): array for name, array in arrays.items()},
            track=track,
        )
    except (ValueError, KeyError, TypeError, EOFError, OSError, zipfile.BadZipFile):
        raise CheckpointError(f"{path}: it is no checkpoint of a swimmer") from None


def _flat(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every value, by its key in dotted form."""
    if not isinstance(settings, Mapping):
        yield prefix, settings
        return
    for key, value in settings.items():
        yield from _flat(value, f"{prefix}.{key}" if prefix else key)


def _spelled(value: Any) -> str:
    return msgspec.json.encode(value).decode()
