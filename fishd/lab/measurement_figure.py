"""The picture of a measurement: raw force, fitted drift, and what is left as thrust."""

import os

import numpy as np

from fishd.core import text
from fishd.lab.drawing import BLACK, BLUE, GREY, ORANGE, drawn, plain
from fishd.lab.measurement import Measured


def draw(found: Measured, tick: float, path: str | os.PathLike[str]) -> None:
    """Draw a measurement into a file; the suffix chooses the format.

    tick: period of the loop [s]
    Raises `FishdError` where it cannot be written, and `MissingPackage`.
    """
    first = found.ticks[0].seq
    time = np.array([each.seq - first for each in found.ticks]) * tick
    force = 1e3 * np.array([each.fx for each in found.ticks])
    blocks = found.blocks
    thrust = 1e3 * (blocks.force - found.drift)
    with drawn(path, (7.0, 5.0)) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        above.plot(time, force, color="0.8", linewidth=0.5, label="each tick")
        for swims, colour, what in ((True, BLUE, "a beat"), (False, ORANGE, "a piece of a rest")):
            chosen = blocks.swims == swims
            for axes, values in ((above, 1e3 * blocks.force), (below, thrust)):
                axes.plot(
                    blocks.time[chosen],
                    values[chosen],
                    ".",
                    color=colour,
                    label=what if axes is above else None,
                )
        above.plot(blocks.time, 1e3 * found.drift, color=BLACK, label="drift as fitted")
        above.set_ylabel(f"F$_x$ as measured [m{plain(found.unit)}]")
        outer = 1e3 * np.concatenate((blocks.force, found.drift))
        room = 0.35 * (outer.max() - outer.min()) + 1.0
        above.set_ylim(outer.min() - room, outer.max() + room)
        above.legend(ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.2))
        whole = found.error if found.total_ci95 is None else found.total_ci95
        level, error = 1e3 * found.thrust, 1e3 * whole
        below.axhspan(level - error, level + error, color=BLUE, alpha=0.2, linewidth=0)
        below.axhline(level, color=BLUE, linewidth=0.8)
        below.axhline(0.0, color=GREY, linewidth=0.6)
        below.set_ylabel(f"without drift [m{plain(found.unit)}]")
        below.set_xlabel("time [s]")
        below.set_title(
            plain(f"{found.controller}: {text.format_measured(found.thrust, whole, found.unit)}")
        )
