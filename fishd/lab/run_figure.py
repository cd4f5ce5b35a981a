"""A picture of a recording: forces, command, thrust, a controller's own, and a phase portrait."""

import os
from typing import TYPE_CHECKING

import numpy as np

from fishd.core import text
from fishd.lab.drawing import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, drawn
from fishd.lab.run_traces import PORTRAIT, Traces

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_LABELS = 12
"""With more events than this, they are lines without a text."""
COLOURS = {"mark": PURPLE, "fault": ORANGE, "fallback": ORANGE}


def picture(traces: Traces, path: str | os.PathLike[str]) -> None:
    """Write the picture; raises `FishdError` where it cannot be, and `MissingPackage`."""
    panels = 3 + len(traces.quantities)
    with drawn(path, (10.0, 1.9 + 1.45 * panels)) as figure:
        figure.suptitle(_plain(traces.title), x=0.01, ha="left", fontsize=10)
        grid = figure.add_gridspec(1, 2, width_ratios=(3, 1))
        left, right = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
        axes = list(left.subplots(panels, 1, sharex=True))
        _forces(axes[0], traces)
        _command(axes[1], traces)
        _thrust(axes[2], traces)
        for axis, (name, values) in zip(axes[3:], traces.quantities.items(), strict=True):
            axis.plot(traces.time, values, color=GREEN, linewidth=0.9)
            axis.set_ylabel(_plain(name))
        axes[-1].set_xlabel("time (s)")
        axes[0].set_xlim(traces.time[0], max(traces.time[-1], traces.time[0] + 0.1))
        for axis in axes:
            _events(axis, traces, named=axis is axes[0])
        _portrait(right.add_subplot(right.add_gridspec(panels, 1)[:2]), traces)


def _forces(axis: "Axes", traces: Traces) -> None:
    axis.axhline(0.0, color="0.85", linewidth=0.6)
    axis.plot(traces.time, traces.fy, color=ORANGE, linewidth=0.7, label="$F_y$")
    axis.plot(traces.time, traces.fx, color=BLUE, linewidth=0.9, label="$F_x$")
    axis.set_ylabel(f"force ({traces.unit})")
    _legend(axis)


def _command(axis: "Axes", traces: Traces) -> None:
    axis.axhline(0.0, color="0.85", linewidth=0.6)
    # A command holds until the next one.
    axis.plot(
        traces.time,
        traces.phi_c,
        drawstyle="steps-post",
        label="command $φ_c$",
        color=BLACK,
        linewidth=0.9,
    )
    if traces.alpha is not None:
        axis.plot(traces.time, traces.alpha, color=GREEN, linewidth=0.9, label="true fin angle α")
    axis.set_ylabel("angle (rad)")
    _legend(axis)


def _thrust(axis: "Axes", traces: Traces) -> None:
    axis.axhline(0.0, color="0.85", linewidth=0.6)
    axis.plot(traces.time, traces.thrust, color=BLUE, label="thrust over whole beats")
    if np.isfinite(traces.thrust_error).any():
        low, high = traces.thrust - traces.thrust_error, traces.thrust + traces.thrust_error
        axis.fill_between(traces.time, low, high, color=BLUE, alpha=0.2, linewidth=0, label="95 %")
    axis.set_ylabel(f"thrust ({traces.unit})")
    other = axis.twinx()
    other.plot(traces.time, traces.frequency, color=GREY, linewidth=0.8)
    other.set_ylabel("tail beat (Hz)", color="0.4")
    other.set_ylim(bottom=0.0)
    other.spines["right"].set_visible(True)
    _headroom(other)
    _legend(axis)


def _legend(axis: "Axes") -> None:
    """Above the curves."""
    _headroom(axis)
    axis.legend(loc="upper right", ncols=2, borderaxespad=0.1)


def _headroom(axis: "Axes") -> None:
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.25 * (high - low))


def _events(axis: "Axes", traces: Traces, *, named: bool) -> None:
    labels = named and len(traces.events) <= MOST_LABELS
    for index, (time, event) in enumerate(traces.events):
        colour = COLOURS.get(event.kind, GREY)
        axis.axvline(time, color=colour, linewidth=0.7, linestyle="--")
        if labels:
            said = event.message if event.kind == "mark" else event.kind
            where = axis.get_xaxis_transform()
            axis.text(
                time,
                1.02 + 0.09 * (index % 2),  # neighbours do not cover one another
                _plain(said),
                transform=where,
                fontsize=6.5,
                color=colour,
            )


def _portrait(axis: "Axes", traces: Traces) -> None:
    if traces.alpha is not None and traces.alpha_rate is not None:
        across, up = traces.alpha, traces.alpha_rate
        axis.set_xlabel("true fin angle α (rad)")
        axis.set_ylabel("its rate (rad/s)")
    else:
        across, up = traces.fin_velocity, traces.fy
        axis.set_xlabel("fin velocity, as estimated")
        axis.set_ylabel(f"$F_y$ ({traces.unit})")
    axis.axhline(0.0, color="0.85", linewidth=0.6)
    axis.axvline(0.0, color="0.85", linewidth=0.6)
    axis.plot(across[traces.portrait], up[traces.portrait], color=GREEN, linewidth=0.7, marker=".")
    axis.set_title(f"phase portrait, last {PORTRAIT:g} s")


def _plain(words: str) -> str:
    """A line that matplotlib does not read as mathematics."""
    return text.line(words, 120).replace("$", r"\$")
