"""Picture of a tail beat: midlines relative to the mean, and the amplitude along the body."""

import os

import numpy as np

from fishd.lab.drawing import BLACK, GREY, open_figure
from fishd.lab.swimmer.envelope import PHASE_COUNT, Envelope

LINE_COUNT = 16
"""Number of midlines drawn of a beat."""
_COLOURS, _DARKENING = "twilight", 0.85
"""Cyclic colour map, and the factor that darkens it for a white page."""


def draw_midlines(envelope: Envelope, title: str, path: str | os.PathLike[str]) -> None:
    """Write the draw_midlines as PNG, PDF or SVG; raises `FishdError` and `MissingPackage`."""
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
        upper.set_ylabel("y/L (1)")
        upper.set_aspect("equal", adjustable="datalim")
        upper.set_title(title, fontweight="normal")
        phases = ScalarMappable(
            BoundaryNorm(np.arange(LINE_COUNT + 1) / LINE_COUNT, LINE_COUNT),
            ListedColormap(colours),
        )
        bar = figure.colorbar(phases, cax=upper.inset_axes((1.01, 0.0, 0.018, 1.0)))
        bar.set_label("phase of the beat (1)")
        bar.set_ticks([0.0, 0.25, 0.5, 0.75, 1.0])
        bar.minorticks_off()
        lower.fill_between(
            envelope.along, mean - spread, mean + spread, color="0.85", linewidth=0.0
        )
        lower.plot(envelope.along, mean, color=BLACK)
        lower.set_ylim(bottom=0.0)
        lower.set_xlim(-0.05, 1.05)
        lower.set_xlabel("x/L (1), from the head on")
        lower.set_ylabel("amplitude/L (1)")
        beats = len(envelope.amplitudes)
        spread_note = f", and how {beats} beats differ (standard deviation)" if beats > 1 else ""
        lower.set_title(
            f"amplitude along the body{spread_note}; at the tail {mean[-1]:.3f} L",
            fontweight="normal",
            color=GREY,
        )
