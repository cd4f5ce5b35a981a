"""The NPZ file of a swim: its track, its midlines, and the state from which it resumes.

Body, water, time and instruction angle continue exactly. The controller is not stored: it restarts
from that angle.
"""

import io
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Struct

from fishd.core import files
from fishd.core.errors import FishdError
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.midlines import Midlines
from fishd.virtual.swimmer.robot import Swimmer
from fishd.virtual.swimmer.track import COLUMNS, MAX_FILE_BYTES, Track

FORMAT = 3
_STATE = "state."
MIDLINE_ARRAYS = ("midline_time", "midlines")


class _About(Struct):
    settings: dict[str, Any]
    controller: str
    parameters: dict[str, Any]
    command: list[str]


class CheckpointError(FishdError):
    """A file is not a checkpoint, or not one of this fish."""


class Checkpoint(NamedTuple):
    """Content of a checkpoint file."""

    path: Path
    settings: dict[str, Any]
    """Settings that the motion depends on, as in the configuration."""
    controller: str
    parameters: dict[str, Any]
    command: list[str]
    """Arguments of `fishctl simulate` that a resumed swim takes over."""
    state: dict[str, Array]
    track: Array
    """Rows up to the checkpoint, shape (ticks, columns)."""
    midlines: Midlines
    """Midlines up to the checkpoint."""

    @property
    def time(self) -> float:
        """Time of the fish [s]."""
        return float(self.track[-1, 0])

    def check(self, settings: Mapping[str, Any]) -> None:
        """Raise `CheckpointError` where the settings of its fish differ from these."""
        own_values, stored_values = dict(_flatten(settings)), dict(_flatten(self.settings))
        for key in own_values | stored_values:
            if own_values.get(key) != stored_values.get(key):
                raise CheckpointError(
                    f"{self.path}: it is of a swim with {key} {_to_json(stored_values.get(key))}, "
                    f"and here it is {_to_json(own_values.get(key))}; the same value is needed"
                )

    def put_into(self, swimmer: Swimmer) -> None:
        """Restore the fish from the checkpoint; on `CheckpointError` the fish is unchanged."""
        self.check_state(swimmer.state())
        swimmer.restore(self.state)

    def check_state(self, fresh: Mapping[str, Array]) -> None:
        """Raise `CheckpointError` where an array is missing, or of another shape or type.

        fresh: state of such a fish at its start, or a part of it
        """
        for name, model in fresh.items():
            array = self.state.get(name)
            if array is None or (array.shape, array.dtype) != (model.shape, model.dtype):
                raise CheckpointError(
                    f"{self.path}: it is of another version of fishd, and does not fit ({name!r})"
                )


def save(
    path: Path,
    swimmer: Swimmer,
    track: Track,
    midlines: Midlines,
    settings: Mapping[str, Any],
    controller: str,
    parameters: Mapping[str, Any],
    command: Sequence[str] = (),
) -> None:
    """Write the file of a swim atomically; raises OSError."""
    about = {
        "format": FORMAT,
        "columns": list(COLUMNS),
        "settings": settings,
        "controller": controller,
        "parameters": parameters,
        "command": command,
    }
    content = io.BytesIO()
    arrays: dict[str, Any] = {_STATE + name: array for name, array in swimmer.state().items()}
    arrays |= {**track.columns(), **dict(zip(MIDLINE_ARRAYS, midlines.arrays(), strict=True))}
    np.savez(content, about=np.array(msgspec.json.encode(about).decode()), **arrays)
    files.write_atomically(path, content.getvalue())


def load(path: Path) -> Checkpoint:
    """Read a checkpoint; raises `CheckpointError`."""
    try:
        content = files.read(path, MAX_FILE_BYTES, "a checkpoint")
    except files.FileProblem as problem:
        raise CheckpointError(f"{path}: {problem}") from None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > MAX_FILE_BYTES:
            raise CheckpointError(
                f"{path}: it would be longer than {MAX_FILE_BYTES / 2**20:g} MB unpacked"
            )
        with np.load(io.BytesIO(content), allow_pickle=False) as npz:
            arrays = {name: npz[name] for name in npz.files}
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
        rows = np.stack([arrays.pop(name) for name in COLUMNS], axis=1)
        midlines = Midlines(*(arrays.pop(name) for name in MIDLINE_ARRAYS))
    except CheckpointError:
        raise
    except Exception:  # NumPy and zipfile raise many kinds of errors for other files
        raise CheckpointError(f"{path}: it is not a swim of 'fishctl simulate --to'") from None
    return Checkpoint(
        path=path,
        settings=about.settings,
        controller=about.controller,
        parameters=about.parameters,
        command=about.command,
        state={name.removeprefix(_STATE): array for name, array in arrays.items()},
        track=rows,
        midlines=midlines,
    )


def _flatten(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value with its dotted key."""
    if not isinstance(settings, Mapping):
        yield prefix, settings
        return
    for key, value in settings.items():
        yield from _flatten(value, f"{prefix}.{key}" if prefix else key)


def _to_json(value: Any) -> str:
    return msgspec.json.encode(value).decode()
