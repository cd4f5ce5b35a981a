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
from msgspec import Struct

from fishd.core import files
from fishd.core.errors import FishdError
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.robot import Swimmer
from fishd.virtual.swimmer.track import COLUMNS, LONGEST, Track

FORMAT = 2
_STATE = "state."


class _About(Struct):
    settings: dict[str, Any]
    controller: str
    parameters: dict[str, Any]


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
        return float(self.track[-1, 0])

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
        """Let the fish go on from here; raises `CheckpointError`, and the fish is as it was."""
        self.check_state(swimmer.state())
        step = swimmer.settings.numerics.step
        time, end = int(self.state["steps"]) * step, self.track[-1, 0]
        if abs(time - end) > 0.5 * step:
            raise _damaged(
                self.path, "track", f"ends at {end:.6g} s, and the fish is at {time:.6g} s"
            )
        swimmer.restore(self.state)

    def check_state(self, fresh: Mapping[str, Array]) -> None:
        """Raises `CheckpointError` where an array does not fit, or is not finite.

        fresh: the state of such a fish at its start, or a part of it
        """
        for name, model in fresh.items():
            found = self.state.get(name)
            if found is None:
                raise CheckpointError(
                    f"{self.path}: it is of another version of fishd, and does not fit ({name!r})"
                )
            if (found.shape, found.dtype) != (model.shape, model.dtype):
                raise _damaged(
                    self.path,
                    name,
                    f"is of shape {found.shape} and type {found.dtype}, and needs to be of shape "
                    f"{model.shape} and type {model.dtype}",
                )
            if not np.isfinite(found[np.isfinite(model)]).all() or np.isinf(found).any():
                raise _damaged(self.path, name, "has values that are not finite")
        if int(self.state["steps"]) < 0:
            raise _damaged(self.path, "steps", "is negative")


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
        "columns": list(COLUMNS),
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
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > LONGEST:
            raise _damaged(path, "it", f"would be longer than {LONGEST / 2**20:g} MB unpacked")
        with np.load(io.BytesIO(content), allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        about = msgspec.json.decode(str(arrays.pop("about")))
        if about["format"] != FORMAT:
            raise CheckpointError(
                f"{path}: it is a checkpoint of format {about['format']}, and this fishd reads "
                f"format {FORMAT}"
            )
        if about["columns"] != list(COLUMNS):
            raise CheckpointError(
                f"{path}: it is of another version of fishd, whose track has other columns"
            )
        about = msgspec.convert(about, _About)
        track = arrays.pop("track")
    except CheckpointError:
        raise
    except Exception:  # NumPy and zipfile raise of all kinds for what is no archive of arrays
        raise CheckpointError(f"{path}: it is no checkpoint of a swimmer") from None
    if track.ndim != 2 or track.shape[1] != len(COLUMNS) or not len(track):
        raise _damaged(path, "track", f"is of shape {track.shape}, not a row for each tick")
    if track.dtype != np.float64 or not np.isfinite(track).all():
        raise _damaged(path, "track", "has values that are not finite numbers")
    return Checkpoint(
        path=path,
        settings=about.settings,
        controller=about.controller,
        parameters=about.parameters,
        state={name.removeprefix(_STATE): array for name, array in arrays.items()},
        track=track,
    )


def _damaged(path: Path, name: str, how: str) -> CheckpointError:
    return CheckpointError(f"{path}: it is damaged: {name} {how}")


def _flat(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every value, by its key in dotted form."""
    if not isinstance(settings, Mapping):
        yield prefix, settings
        return
    for key, value in settings.items():
        yield from _flat(value, f"{prefix}.{key}" if prefix else key)


def _spelled(value: Any) -> str:
    return msgspec.json.encode(value).decode()
