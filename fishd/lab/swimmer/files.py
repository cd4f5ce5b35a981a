"""Sources of the pictures of a free swimmer: checkpoints, and the midlines of a saved swim."""

import io
import zipfile
from pathlib import Path

import msgspec
import numpy as np

from fishd.core import files
from fishd.core.errors import FishdError
from fishd.lab.swimmer.envelope import Array
from fishd.virtual.swimmer.checkpoint import Checkpoint, CheckpointError
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.settings import SwimmerSettings
from fishd.virtual.swimmer.track import MAX_FILE_BYTES


def restore_fish(checkpoint: Checkpoint) -> Fish:
    """Return the fish of a checkpoint, in the state of the checkpoint; raises `CheckpointError`."""
    try:
        settings = msgspec.convert(checkpoint.settings["swimmer"], SwimmerSettings)
        fish = Fish(settings)
        checkpoint.check_state(fish.state())
        fish.restore(checkpoint.state)
    except (KeyError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint.path}: it was written by an incompatible version of fishd ({error})"
        ) from None
    return fish


def read_midlines(path: Path) -> tuple[Array, Array]:
    """Read the times, shape (n,) [s], and the midlines, shape (n, points, 2) [m].

    path: file written by `fishctl simulate --save`
    Raises `FishdError`.
    """
    needed = "a swim that fishctl simulate --save FILE.npz has written"
    try:
        content = files.read(path, MAX_FILE_BYTES, "a swim")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            time, lines = (
                np.asarray(arrays[name], np.float64) for name in ("midline_time", "midlines")
            )
    except files.FileProblem as problem:
        raise FishdError(f"{path}: {problem}; {needed} is needed") from None
    except KeyError:
        raise FishdError(f"{path}: it contains no midlines; {needed} is needed") from None
    except (ValueError, TypeError, EOFError, OSError, zipfile.BadZipFile, AttributeError):
        raise FishdError(f"{path}: not an NPZ file of arrays; {needed} is needed") from None
    if lines.ndim != 3 or lines.shape[1] < 10 or lines.shape[2] != 2 or len(time) != len(lines):
        raise FishdError(f"{path}: its midlines have the wrong shape; {needed} is needed")
    return time, lines
