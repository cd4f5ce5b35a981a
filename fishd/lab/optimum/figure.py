"""Picture of an optimal control: the command, and the costate that shows it to be optimal."""

import os

import numpy as np

from fishd.lab import drawing
from fishd.lab.drawing import BLACK, BLUE, GREEN, ORANGE
from fishd.lab.optimum.optimal_control import Array, OptimalControl


def draw(control: OptimalControl, path: str | os.PathLike[str]) -> None:
    """Draw two periods of the command, wheel and fin, of the costate, and of the thrust.

    path: as for `drawing.open_figure`, whose errors are raised
    """
    limit = control.amplitude
    n = len(control.time)
    edges = control.period / n * np.arange(2 * n + 1)
    with drawing.open_figure(path, (6.4, 5.2)) as figure:
        angles, costate, force = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 2))
        angles.stairs(_repeat_twice(control.command), edges, baseline=None, color=BLACK, lw=1.3)
        angles.plot(edges, _repeat_and_close(control.wheel), color=BLUE, ls=(0, (4, 2)))
        angles.plot(edges, _repeat_and_close(control.fin), color=ORANGE)
        labels = ("command $φ_c$", "wheel $φ$", "fin $α$")
        angles.legend(
            [angles.patches[0], *angles.lines], labels, loc="lower left", ncols=3,
            bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2,
        )  # fmt: skip
        angles.set_yticks((-limit, 0.0, limit), ("−Φ", "0", "Φ"))
        angles.set_ylabel(f"angle\n(Φ = {limit:g} rad)")
        costate.axhline(0.0, color="0.8", lw=0.7)
        midpoints = edges[:-1] + 0.5 * edges[1]
        costate.plot(midpoints, _repeat_twice(control.costate), color=GREEN)
        costate.set_yticks((-1, 0, 1))
        costate.set_ylabel("costate $p$\nof the wheel (–)")
        force.axhline(0.0, color="0.8", lw=0.7)
        force.plot(midpoints, 1e3 * _repeat_twice(control.force), color=BLACK)
        force.axhline(1e3 * control.thrust, color=ORANGE, ls=(0, (4, 2)))
        force.set_title(
            f"mean {1e3 * control.thrust:.2f} mN, {control.ratio:.2%} of the best square wave",
            fontweight="normal", color=ORANGE,
        )  # fmt: skip
        force.set_ylabel("thrust $F_x$ (mN)")
        force.set_xlabel("time (s)")
        force.set_xlim(0.0, edges[-1])
        for axes in (angles, costate, force):
            for k in np.flatnonzero(np.diff(np.sign(_repeat_twice(control.costate)))):
                axes.axvline(edges[k + 1], color="0.85", lw=0.7, zorder=0)


def _repeat_twice(values: Array) -> Array:
    return np.tile(values, 2)


def _repeat_and_close(values: Array) -> Array:
    return np.append(_repeat_twice(values), values[0])
