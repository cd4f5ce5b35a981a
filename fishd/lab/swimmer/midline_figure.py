"""The picture of a tail beat: midlines relative to the mean, and the amplitude along the body."""

import os

import numpy as np

from fishd.lab.drawing import BLACK, GREY, drawn
from fishd.lab.swimmer.envelope import PHASES, Envelope

LINES = 16
"""Midlines that are drawn of a beat."""
_COLOURS, _DARKER = "twilight", 0.85
"""Colours that begin again where they end, and are seen on white."""


def picture(found: Envelope, title: str, path: str | os.PathLike[str]) -> None:
    """Write it as PNG, PDF or SVG; raises `FishdError` where that cannot be, `MissingPackage`."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import BoundaryNorm, ListedColormap

    mean = found.amplitudes.mean(axis=0)
    spread = found.amplitudes.std(axis=0, ddof=1) if len(found.amplitudes) > 1 else 0.0 * mean
    shares = np.arange(LINES) / LINES
    colours = _DARKER * colormaps[_COLOURS](shares)[:, :3]
    with drawn(path, (7.2, 5.0)) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for line, colour in zip(found.midlines[:: PHASES // LINES], colours, strict=True):
            upper.plot(*line.T, color=colour, linewidth=1.0)
        upper.set_ylabel("y/L (1)")
        upper.set_aspect("equal", adjustable="datalim")
        upper.set_title(title, fontweight="normal")
        phases = ScalarMappable(
            BoundaryNorm(np.arange(LINES + 1) / LINES, LINES), ListedColormap(colours)
        )
        bar = figure.colorbar(phases, cax=upper.inset_axes((1.01, 0.0, 0.018, 1.0)))
        bar.set_label("phase of the beat (1)")
        bar.set_ticks([0.0, 0.25, 0.5, 0.75, 1.0])
        bar.minorticks_off()
        lower.fill_between(found.along, mean - spread, mean + spread, color="0.85", linewidth=0.0)
        lower.plot(found.along, mean, color=BLACK)
        lower.set_ylim(bottom=0.0)
        lower.set_xlim(-0.05, 1.05)
        lower.set_xlabel("x/L (1), from the head on")
        lower.set_ylabel("amplitude/L (1)")
        beats = len(found.amplitudes)
        each = f", and how {beats} beats differ (standard deviation)" if beats > 1 else ""
        lower.set_title(
            f"amplitude along the body{each}; at the tail {mean[-1]:.3f} L",
            fontweight="normal",
            color=GREY,
        )
