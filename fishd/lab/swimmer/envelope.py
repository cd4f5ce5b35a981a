"""Motion of the body in a tail beat: midlines relative to the mean, and their amplitudes."""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.core.errors import FishdError

Array = NDArray[np.float64]
PHASE_COUNT = 64
"""Number of midlines of each beat."""


class Envelope(NamedTuple):
    """Midlines over whole tail beats, in a frame that moves with the fish; in body lengths.

    The mean position of the body and its mean velocity over the beat are subtracted. The mean
    direction of the body is the x axis.
    """

    along: Array
    """Positions along the body, 0 at the head, 1 at the tail; shape (slices,)."""
    midlines: Array
    """Midlines of the last beat at `PHASE_COUNT` equal steps; shape (PHASE_COUNT, slices, 2).

    x is measured from the mean position of the head, y across the axis.
    """
    amplitudes: Array
    """Amplitude of each position across the axis; shape (beats, slices)."""
    periods: Array
    """Periods of the beats [s]; shape (beats,)."""


def compute_envelope(time: Array, midlines: Array, since: float = 0.0) -> Envelope:
    """Return the midlines over all whole tail beats after `since` [s].

    time: shape (n,) [s]
    midlines: points along the body in the laboratory frame, shape (n, slices, 2) [m]

    Raises `FishdError` if the tail does not complete a beat.
    """
    later = time >= since
    time, midlines = time[later], midlines[later]
    beat_starts = _find_beats(time, midlines)
    if len(beat_starts) < 2:
        raise FishdError(
            f"the tail does not complete a beat after {since:g} s, where the midlines begin: "
            "choose a shorter --settle"
        )
    length = float(np.linalg.norm(np.diff(midlines[0], axis=0), axis=1).sum())
    beats = [
        _to_body_frame(beat) / length for beat in _interpolate_beats(time, midlines, beat_starts)
    ]
    swings = [0.5 * (beat[..., 1].max(axis=0) - beat[..., 1].min(axis=0)) for beat in beats]
    last = beats[-1] - np.array([beats[-1][:, 0, 0].mean(), 0.0])
    along = np.linspace(0.0, 1.0, midlines.shape[1])
    return Envelope(along, last, np.array(swings), np.diff(beat_starts))


def _find_beats(time: Array, midlines: Array) -> Array:
    """Return the times at which the tail crosses the axis of the body upwards, once a beat [s].

    A crossing counts only after the tail was below by a quarter of its swing.
    """
    axis = midlines[:, midlines.shape[1] * 2 // 5] - midlines[:, 0]
    arm = midlines[:, -1] - midlines[:, 0]
    across = (axis[:, 0] * arm[:, 1] - axis[:, 1] * arm[:, 0]) / np.hypot(*axis.T)
    if not len(across):
        return np.empty(0)
    across = across - 0.5 * (across.max() + across.min())
    threshold = 0.25 * float(np.abs(across).max())
    times: list[float] = []
    was_low = False
    for (t0, before), (t1, after) in pairwise(zip(time, across, strict=True)):
        was_low |= before < -threshold
        if was_low and before < 0.0 <= after:
            times.append(float(t0 + (t1 - t0) * before / (before - after)))
            was_low = False
    return np.array(times)


def _interpolate_beats(time: Array, midlines: Array, beat_starts: Array) -> Iterator[Array]:
    """Yield the midlines of a beat and the first of the next; (PHASE_COUNT + 1, slices, 2) [m]."""
    for begin, end in pairwise(beat_starts):
        wanted = np.linspace(begin, end, PHASE_COUNT + 1)
        after = np.clip(np.searchsorted(time, wanted), 1, len(time) - 1)
        share = (wanted - time[after - 1]) / (time[after] - time[after - 1])
        share = share[:, None, None]
        yield (1.0 - share) * midlines[after - 1] + share * midlines[after]


def _to_body_frame(beat: Array) -> Array:
    """Return midlines without the mean motion of the body, their mean direction along x."""
    centroid = beat.mean(axis=1)
    shares = np.linspace(-0.5, 0.5, PHASE_COUNT + 1)[:-1]
    motion = centroid[:-1].mean(axis=0) + shares[:, None] * (centroid[-1] - centroid[0])
    centred = beat[:-1] - motion[:, None]
    direction = (centred[:, -1] - centred[:, 0]).mean(axis=0)
    c, s = direction / np.hypot(*direction)
    return np.asarray(centred @ np.array([[c, -s], [s, c]]))
