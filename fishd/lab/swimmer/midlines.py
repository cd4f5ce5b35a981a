"""Motion of the body in a tail beat: midlines relative to the mean, and their amplitudes."""

import os
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.core.errors import FishdError
from fishd.lab.drawing import BLACK, GREY, load_matplotlib, open_figure

Array = NDArray[np.float64]
PHASE_COUNT = 64
"""Number of midlines of each beat."""
LINE_COUNT = 16
"""Number of midlines drawn of a beat."""
_COLOURS, _DARKENING = "twilight", 0.85
"""Cyclic colour map, and the factor that darkens it for a white page."""


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


def draw_midlines(envelope: Envelope, title: str, path: str | os.PathLike[str]) -> None:
    """Write the picture as PNG, PDF or SVG; raises `FishdError` and `MissingPackage`."""
    load_matplotlib()
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, ListedColormap

    mean = envelope.amplitudes.mean(axis=0)
    spread = envelope.amplitudes.std(axis=0, ddof=1) if len(envelope.amplitudes) > 1 else 0.0 * mean
    phases_of_lines = np.arange(LINE_COUNT) / LINE_COUNT
    colours = _DARKENING * colormaps[_COLOURS](phases_of_lines)[:, :3]
    with open_figure(path, (7.2, 5.0)) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for line, colour in zip(
            envelope.midlines[:: PHASE_COUNT // LINE_COUNT], colours, strict=True
        ):
            upper.plot(*line.T, color=colour, linewidth=1.0)
        upper.set_ylabel("y/L (–)")
        upper.set_aspect("equal", adjustable="datalim")
        upper.set_title(title, fontweight="normal")
        phases = ScalarMappable(
            BoundaryNorm(np.arange(LINE_COUNT + 1) / LINE_COUNT, LINE_COUNT),
            ListedColormap(colours),
        )
        bar = figure.colorbar(phases, cax=upper.inset_axes((1.01, 0.0, 0.018, 1.0)))
        bar.set_label("phase of the beat (–)")
        bar.set_ticks([0.0, 0.25, 0.5, 0.75, 1.0])
        bar.minorticks_off()
        lower.fill_between(
            envelope.along, mean - spread, mean + spread, color="0.85", linewidth=0.0
        )
        lower.plot(envelope.along, mean, color=BLACK)
        lower.set_ylim(bottom=0.0)
        lower.set_xlim(-0.05, 1.05)
        lower.set_xlabel("x/L (–), from the head on")
        lower.set_ylabel("amplitude/L (–)")
        beats = len(envelope.amplitudes)
        spread_note = f", and how {beats} beats differ (standard deviation)" if beats > 1 else ""
        lower.set_title(
            f"amplitude along the body{spread_note}; at the tail {mean[-1]:.3f} L",
            fontweight="normal",
            color=GREY,
        )
