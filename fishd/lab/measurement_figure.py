"""Figure of a measurement: raw force, fitted drift, and their difference, the thrust."""

import os

import numpy as np

from fishd.core import text
from fishd.lab.drawing import BLACK, BLUE, GREY, ORANGE, open_figure, plain
from fishd.lab.measurement import ThrustMeasurement


def draw(measurement: ThrustMeasurement, tick: float, path: str | os.PathLike[str]) -> None:
    """Draw a measurement into a file whose suffix chooses the format.

    tick: period of the loop [s]
    Raises `FishdError` where the file cannot be written, and `MissingPackage`.
    """
    first = measurement.ticks[0].seq
    time = np.array([sample.seq - first for sample in measurement.ticks]) * tick
    force = 1e3 * np.array([sample.fx for sample in measurement.ticks])
    blocks = measurement.blocks
    thrust = 1e3 * (blocks.force - measurement.drift)
    with open_figure(path, (7.0, 5.0)) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(time, force, color="0.8", linewidth=0.5, label="each tick")
        for swims, colour, label in ((True, BLUE, "a beat"), (False, ORANGE, "a piece of a rest")):
            chosen = blocks.swims == swims
            for axes, values in ((above, 1e3 * blocks.force), (below, thrust)):
                axes.plot(
                    blocks.time[chosen],
                    values[chosen],
                    ".",
                    color=colour,
                    label=label if axes is above else None,
                )
        above.plot(blocks.time, 1e3 * measurement.drift, color=BLACK, label="drift as fitted")
        above.set_ylabel(f"F$_x$ as measured (m{plain(measurement.force_unit)})")
        extremes = 1e3 * np.concatenate((blocks.force, measurement.drift))
        margin = 0.35 * (extremes.max() - extremes.min()) + 1.0
        above.set_ylim(extremes.min() - margin, extremes.max() + margin)
        above.legend(ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.2))
        half_width = measurement.known_ci95
        level, error = 1e3 * measurement.thrust, 1e3 * (half_width or 0.0)
        below.axhspan(level - error, level + error, color=BLUE, alpha=0.2, linewidth=0)
        below.axhline(level, color=BLUE, linewidth=0.8)
        below.axhline(0.0, color=GREY, linewidth=0.6)
        below.set_ylabel(f"without drift (m{plain(measurement.force_unit)})")
        below.set_xlabel("time (s)")
        below.set_title(
            plain(
                f"{measurement.controller}: "
                f"{text.format_measured(measurement.thrust, half_width, measurement.force_unit)}"
            )
        )
