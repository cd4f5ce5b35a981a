"""How the body moves in a tail beat: its midlines relative to the mean, and how far each swings."""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.core.errors import FishdError

Array = NDArray[np.float64]
PHASES = 64
"""Midlines that are taken of each beat."""


class Envelope(NamedTuple):
    """Midlines over whole tail beats, in a frame that swims along; in lengths of the fish.

    Of each beat, the mean place of the body and its mean speed from the beginning to the end are
    left out, and the mean direction of the body is the axis.
    """

    along: Array
    """Places along the body, 0 at the head, 1 at the tail; shape (slices,)."""
    midlines: Array
    """Of the last beat, at `PHASES` equal steps; x from the mean head on, y across; shape
    (PHASES, slices, 2)."""
    amplitudes: Array
    """Half of how far each place swings across the axis; shape (beats, slices)."""
    periods: Array
    """Of the beats [s]."""


def envelope(time: Array, midlines: Array, since: float = 0.0) -> Envelope:
    """The midlines over all whole tail beats after `since` [s].

    time: shape (n,) [s]; midlines: places along the body in the laboratory, shape (n, slices, 2)
    [m]

    Raises `FishdError` where there is no whole beat.
    """
    later = time >= since
    time, midlines = time[later], midlines[later]
    begins = _beats(time, midlines)
    if len(begins) < 2:
        raise FishdError(
            f"the tail does not beat once after {since:g} s, which is when midlines begin to count "
            "(--settle)"
        )
    length = float(np.linalg.norm(np.diff(midlines[0], axis=0), axis=1).sum())
    beats = [_own_frame(beat) / length for beat in _at_phases(time, midlines, begins)]
    swings = [0.5 * (beat[..., 1].max(axis=0) - beat[..., 1].min(axis=0)) for beat in beats]
    last = beats[-1] - np.array([beats[-1][:, 0, 0].mean(), 0.0])
    along = np.linspace(0.0, 1.0, midlines.shape[1])
    return Envelope(along, last, np.array(swings), np.diff(begins))


def _beats(time: Array, midlines: Array) -> Array:
    """When the tail passes the axis of the body upwards, once a beat [s].

    A passage counts once the tail was a quarter of its swing below.
    """
    axis = midlines[:, midlines.shape[1] * 2 // 5] - midlines[:, 0]
    arm = midlines[:, -1] - midlines[:, 0]
    across = (axis[:, 0] * arm[:, 1] - axis[:, 1] * arm[:, 0]) / np.hypot(*axis.T)
    if not len(across):
        return np.empty(0)
    across = across - 0.5 * (across.max() + across.min())
    enough = 0.25 * float(np.abs(across).max())
    found: list[float] = []
    was_low = False
    for (t0, before), (t1, after) in pairwise(zip(time, across, strict=True)):
        was_low |= before < -enough
        if was_low and before < 0.0 <= after:
            found.append(float(t0 + (t1 - t0) * before / (before - after)))
            was_low = False
    return np.array(found)


def _at_phases(time: Array, midlines: Array, begins: Array) -> Iterator[Array]:
    """The midlines of each beat, the first one of the next beat too: (PHASES + 1, slices, 2) [m]"""
    for begin, end in pairwise(begins):
        wanted = np.linspace(begin, end, PHASES + 1)
        after = np.clip(np.searchsorted(time, wanted), 1, len(time) - 1)
        share = (wanted - time[after - 1]) / (time[after] - time[after - 1])
        share = share[:, None, None]
        yield (1.0 - share) * midlines[after - 1] + share * midlines[after]


def _own_frame(beat: Array) -> Array:
    """Midlines without the motion of the whole, their mean direction along x."""
    middle = beat.mean(axis=1)
    shares = np.linspace(-0.5, 0.5, PHASES + 1)[:-1]
    motion = middle[:-1].mean(axis=0) + shares[:, None] * (middle[-1] - middle[0])
    still = beat[:-1] - motion[:, None]
    direction = (still[:, -1] - still[:, 0]).mean(axis=0)
    c, s = direction / np.hypot(*direction)
    return np.asarray(still @ np.array([[c, -s], [s, c]]))
