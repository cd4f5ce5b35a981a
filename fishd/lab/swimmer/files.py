"""What pictures of a free swimmer are drawn from: checkpoints, and the midlines of a saved swim."""

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
from fishd.virtual.swimmer.track import LONGEST


def fish_of(checkpoint: Checkpoint) -> Fish:
    """The fish as it was; raises `CheckpointError`."""
    try:
        settings = msgspec.convert(checkpoint.settings["swimmer"], SwimmerSettings)
        fish = Fish(settings)
        checkpoint.check_state(fish.state())
        fish.restore(checkpoint.state)
    except (KeyError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint.path}: it is of another version of fishd, and does not fit ({error})"
        ) from None
    return fish


def midlines_of(path: Path) -> tuple[Array, Array]:
    """Times, shape (n,) [s], and midlines in the laboratory, shape (n, places, 2) [m].

    path: as `fishctl simulate --save` writes it
    Raises `FishdError`.
    """
    needed = "a swim that fishctl simulate --save FILE.npz has written"
    try:
        content = files.read(path, LONGEST, "a swim")
        with np.load(io.BytesIO(content), allow_pickle=False) as found:
            time, lines = (
                np.asarray(found[name], np.float64) for name in ("midline_time", "midlines")
            )
    except files.FileProblem as problem:
        raise FishdError(f"{path}: {problem}; {needed} is needed") from None
    except KeyError:
        raise FishdError(f"{path}: it holds no midlines; {needed} is needed") from None
    except (ValueError, TypeError, EOFError, OSError, zipfile.BadZipFile, AttributeError):
        raise FishdError(f"{path}: it is no NPZ file of arrays; {needed} is needed") from None
    if lines.ndim != 3 or lines.shape[1] < 10 or lines.shape[2] != 2 or len(time) != len(lines):
        raise FishdError(f"{path}: its midlines are none: {needed} is needed")
    return time, lines
