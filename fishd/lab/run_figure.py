"""Figure of a recording: forces, command, thrust, controller quantities, and its last beats."""

import os
from typing import TYPE_CHECKING

import numpy as np

from fishd.lab.drawing import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    YELLOW,
    open_figure,
    plain,
)
from fishd.lab.run_traces import (
    MIN_ANGLE_SPAN,
    MIN_FORCE_SPAN,
    MIN_QUANTITY_SPAN,
    PORTRAIT_S,
    Traces,
    limits,
    mean_beat,
    spectrum,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from fishd.lab.run_traces import Array

MAX_LABELLED_EVENTS = 12
"""Largest number of events that have a text; with more, all events are lines only."""
COLOURS = {"mark": PURPLE, "fault": ORANGE, "fallback": ORANGE}


def draw_run(traces: Traces, path: str | os.PathLike[str]) -> None:
    """Write the figure; raises `FishdError` where this fails, and `MissingPackage`."""
    traces = _escape_texts(traces)
    panels = 3 + len(traces.quantities)
    with open_figure(path, (10.0, 1.9 + 1.45 * panels)) as figure:
        figure.suptitle(traces.title, x=0.01, ha="left", fontsize=10)
        grid = figure.add_gridspec(1, 2 if traces.portrait else 1)
        if traces.portrait:
            grid.set_width_ratios((3, 1))
        left = figure.add_subfigure(grid[0])
        axes = list(left.subplots(panels, 1, sharex=True))
        _forces(axes[0], traces)
        _command(axes[1], traces)
        _thrust(axes[2], traces)
        for axis, (name, values) in zip(axes[3:], traces.quantities.items(), strict=True):
            axis.plot(traces.time, values, color=GREEN, linewidth=0.9)
            axis.set_ylim(*limits(MIN_QUANTITY_SPAN, values))
            axis.set_ylabel(name.replace(" (", "\n("))
        axes[-1].set_xlabel("time (s)")
        first, last = traces.time.min(), traces.time.max()  # the clock may have been set
        axes[0].set_xlim(first, max(last, first + 0.1))
        for axis in axes:
            _events(axis, traces, named=axis is axes[0])
        if traces.portrait:
            count = 4 if traces.fin is None else 5
            portrait, amplitude, density, beat, *loop = figure.add_subfigure(grid[1]).subplots(
                count, 1
            )
            _portrait(portrait, traces, traces.portrait)
            if traces.fin is not None:
                _loop(loop[0], traces.phi_c, traces.fin.at_ticks, traces.portrait)
            _spectrum(amplitude, density, traces, traces.portrait)
            _mean_beat(beat, traces, traces.portrait)


def draw_runs(
    runs: "Sequence[tuple[str, Traces]]", left_out: "Sequence[str]", path: str | os.PathLike[str]
) -> None:
    """Write a figure with several runs over each other: thrust, beat, and mean beat of each.

    runs: name and traces of each run; time begins with the swim
    left_out: names of runs that have no recording

    Raises `FishdError` where writing fails, and `MissingPackage`.
    """
    colours = (BLUE, ORANGE, GREEN, PURPLE, YELLOW, BLACK)
    units = sorted({traces.unit for _, traces in runs})
    with open_figure(path, (10.0, 6.4)) as figure:
        thrust, beat, force = figure.subplots(3, 1)
        for index, (name, traces) in enumerate(runs):
            style = {"color": colours[index % len(colours)]}
            style |= {"linestyle": "-" if index < len(colours) else "--"}
            running = np.isfinite(traces.thrust) & (np.nan_to_num(traces.frequency) > 0.0)
            start = traces.time[np.argmax(running)] if running.any() else traces.time[0]
            time, mean = traces.time - start, np.where(running, traces.thrust, np.nan)
            thrust.plot(time, mean, label=plain(name), **style)
            low, high = mean - traces.thrust_ci95, mean + traces.thrust_ci95
            thrust.fill_between(time, low, high, color=style["color"], alpha=0.15, linewidth=0)
            beat.plot(time, np.where(running, traces.frequency, np.nan), linewidth=0.9, **style)
            if (swim := _latest_swim(running)) and (cycle := mean_beat(traces, swim)):
                force.plot(cycle.phase, cycle.fx, linewidth=0.9, **style)
        for axis in (thrust, force):
            axis.axhline(0.0, color="0.85", linewidth=0.6)
        thrust.set_ylabel(f"thrust ({plain(', '.join(units))})")
        missing = f"; no recording: {plain(', '.join(left_out))}" if left_out else ""
        thrust.set_title(f"thrust over whole beats, and its 95 % interval{missing}")
        beat.set_ylabel("tail beat (Hz)")
        beat.set_xlabel("time since the first beat (s)")
        force.set_ylabel(f"mean $F_x$ ({plain(', '.join(units))})")
        force.set_xlabel("phase of the beat, mean of the second half of the latest swim")
        force.set_xlim(0.0, 1.0)
        figure.legend(loc="outside upper left", ncols=4)


def _latest_swim(running: "NDArray[np.bool_]") -> slice | None:
    """Return the second half of the latest samples that are true without a break."""
    swum = np.flatnonzero(running)
    if not len(swum):
        return None
    breaks = np.flatnonzero(~running[: swum[-1]])
    first = int(breaks[-1]) + 1 if len(breaks) else 0
    return slice((first + int(swum[-1])) // 2, int(swum[-1]) + 1)


def _forces(axis: "Axes", traces: Traces) -> None:
    axis.axhline(0.0, color="0.85", linewidth=0.6)
    axis.plot(traces.force_time, traces.fy, color=ORANGE, linewidth=0.7, label="$F_y$")
    axis.plot(traces.force_time, traces.fx, color=BLUE, linewidth=0.9, label="$F_x$")
    axis.set_ylim(*limits(MIN_FORCE_SPAN, traces.fx, traces.fy))
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
    angles = [traces.phi_c] if traces.alpha is None else [traces.phi_c, traces.alpha]
    if fin := traces.fin:
        angles.append(fin.alpha)
        axis.plot(fin.time, fin.alpha, color=BLUE, linewidth=0.9, label="measured fin angle")
        maxima = [(beat.time, beat.alpha_max) for beat in fin.beats]
        axis.plot(
            *np.array(maxima).reshape(-1, 2).T, ".", color=ORANGE, label="its maximum per beat"
        )
    axis.set_ylim(*limits(MIN_ANGLE_SPAN, *angles))
    axis.set_ylabel("angle (rad)")
    _legend(axis)


def _thrust(axis: "Axes", traces: Traces) -> None:
    axis.axhline(0.0, color="0.85", linewidth=0.6)
    axis.plot(traces.time, traces.thrust, color=BLUE, label="thrust over whole beats")
    low, high = traces.thrust - traces.thrust_ci95, traces.thrust + traces.thrust_ci95
    if np.isfinite(traces.thrust_ci95).any():
        axis.fill_between(traces.time, low, high, color=BLUE, alpha=0.2, linewidth=0, label="95 %")
    axis.set_ylim(*limits(MIN_FORCE_SPAN, traces.thrust, low, high))
    axis.set_ylabel(f"thrust ({traces.unit})")
    frequency_axis = axis.twinx()
    beat = frequency_axis.plot(
        traces.time, traces.frequency, color=GREY, linewidth=0.8, label="tail beat"
    )
    frequency_axis.set_ylabel("tail beat (Hz)", color="0.4")
    frequency_axis.set_ylim(0.0, max(1.0, limits(1.0, traces.frequency)[1]))
    frequency_axis.spines["right"].set_visible(True)
    _headroom(frequency_axis)
    _legend(axis, *beat)


def _legend(axis: "Axes", *more: "Artist") -> None:
    """Draw a legend above the curves, with the handles `more` beside those of the axis."""
    _headroom(axis)
    handles = [*axis.get_legend_handles_labels()[0], *more]
    axis.legend(handles=handles, loc="upper right", ncols=3, borderaxespad=0.1)


def _headroom(axis: "Axes") -> None:
    low, high = axis.get_ylim()
    axis.set_ylim(low, high + 0.25 * (high - low))


def _events(axis: "Axes", traces: Traces, *, named: bool) -> None:
    labels = named and len(traces.events) <= MAX_LABELLED_EVENTS
    first, last = axis.get_xlim()
    where = axis.get_xaxis_transform()
    times = [event.time for event in traces.events]
    colours = [COLOURS.get(event.kind, GREY) for event in traces.events]
    axis.vlines(times, 0.0, 1.0, colors=colours, linewidth=0.7, linestyle="--", transform=where)
    for index, (event, colour) in enumerate(zip(traces.events, colours, strict=True)):
        if labels and first <= event.time <= last:
            axis.text(
                event.time,
                1.02 + 0.09 * (index % 2),  # neighbours do not cover one another
                event.text,
                transform=where,
                fontsize=6.5,
                color=colour,
            )


def _portrait(axis: "Axes", traces: Traces, samples: slice) -> None:
    if traces.alpha is not None and traces.alpha_rate is not None:
        x, y = traces.alpha, traces.alpha_rate
        axis.set_xlabel("true fin angle α (rad)")
        axis.set_ylabel("its rate (rad/s)")
    else:
        x, y = traces.fin_velocity, traces.fy
        axis.set_xlabel("fin velocity, as estimated")
        axis.set_ylabel(f"$F_y$ ({traces.unit})")
    axis.axhline(0.0, color="0.85", linewidth=0.6)
    axis.axvline(0.0, color="0.85", linewidth=0.6)
    axis.plot(x[samples], y[samples], color=GREEN, linewidth=0.7, marker=".")
    axis.set_title(f"phase portrait, last {PORTRAIT_S:g} s")


def _loop(axis: "Axes", phi_c: "Array", fin_angle: "Array", samples: slice) -> None:
    # An instruction angle holds until the next tick.
    axis.plot(
        phi_c[samples], fin_angle[samples],
        drawstyle="steps-pre", color=BLUE, linewidth=0.7, marker=".",
    )  # fmt: skip
    axis.set_xlabel("command $φ_c$ (rad)")
    axis.set_ylabel("measured fin angle (rad)")
    axis.set_title("fin angle over command")


def _spectrum(amplitude: "Axes", density: "Axes", traces: Traces, samples: slice) -> None:
    if spectral := spectrum(traces, samples):
        for axis, fx, fy in (
            (amplitude, spectral.fx, spectral.fy),
            (density, spectral.fx_density, spectral.fy_density),
        ):
            axis.plot(spectral.frequency, fy, color=ORANGE, linewidth=0.9, label="$F_y$")
            axis.plot(spectral.frequency, fx, color=BLUE, linewidth=0.9, label="$F_x$")
        _legend(amplitude)
        density.set_yscale("log")
    amplitude.set_ylabel(f"amplitude ({traces.unit})")
    amplitude.set_title("amplitudes of the forces")
    density.set_xlabel("frequency (Hz)")
    density.set_ylabel(f"density ({traces.unit}²/Hz)")
    density.set_title("power spectral density")


def _mean_beat(axis: "Axes", traces: Traces, samples: slice) -> None:
    axis.axhline(0.0, color="0.85", linewidth=0.6)
    if beat := mean_beat(traces, samples):
        axis.plot(beat.phase, beat.fy, color=ORANGE, linewidth=0.9, marker=".", label="$F_y$")
        axis.plot(beat.phase, beat.fx, color=BLUE, linewidth=0.9, marker=".", label="$F_x$")
        _legend(axis)
    axis.set_xlim(0.0, 1.0)
    axis.set_xlabel("phase of the beat")
    axis.set_ylabel(f"force ({traces.unit})")
    axis.set_title("mean beat")


def _escape_texts(traces: Traces) -> Traces:
    """Return the traces with texts in which matplotlib finds no mathematics."""
    return traces._replace(
        title=plain(traces.title),
        unit=plain(traces.unit),
        quantities={plain(name): values for name, values in traces.quantities.items()},
        events=[event._replace(text=plain(event.text)) for event in traces.events],
    )
