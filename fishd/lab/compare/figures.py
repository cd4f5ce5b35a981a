"""Figures of a comparison and of a survey: what each contestant does, and its thrust."""

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from fishd.core import text
from fishd.core.beats import upward_reversals
from fishd.lab.compare.comparison import TRACE_S, Standing, Trace
from fishd.lab.compare.survey import ContestantSurvey
from fishd.lab.drawing import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, open_figure, plain

_WHISKER_GREY = "0.2"
_COLOURS, _MARKERS = (BLUE, ORANGE, GREEN, PURPLE, BLACK), "osD^v"
"""Colour and marker of each contestant of a survey."""
_FORCES = ("$F_x$, drift subtracted", "$F_x$ as measured")
"""Labels of the force, for a real fish and for a simulated one."""
_THRUSTS = ("thrust, measured", "true mean $F_x$")
"""Labels of the mean force, for a real fish and for a simulated one."""


def draw(
    path: str | os.PathLike[str],
    standings: Sequence[Standing],
    traces: Sequence[Trace],
    amplitude: float,
    unit: str = "N",
) -> None:
    """Draw command, fin and force at the end of each contestant's run, and a bar of its result.

    The bar shows the relative thrust for a simulated fish, and the thrust for a real one.
    amplitude: Φ [rad]; unit: unit of forces
    Raises `FishdError` where the file cannot be written, and `MissingPackage`.
    """
    unit = plain(unit)
    rows = len(standings)
    has_best = all(standing.relative_thrust is not None for standing in standings)
    largest = max(standing.thrust + (standing.thrust_ci95 or 0.0) for standing in standings)
    with open_figure(path, (7.6, 0.7 + 1.25 * rows)) as figure:
        axes = figure.subplots(rows, 3, squeeze=False, width_ratios=(3, 3, 1.8))
        forces = [1e3 * force for trace in traces for force in trace.thrust]
        limits = min(0.0, *forces) - 4.0, 1.15 * max(0.0, *forces) + 1.0
        axes[0][1].set_title("force", fontweight="normal")
        axes[0][2].set_title("relative thrust" if has_best else "thrust", fontweight="normal")
        for (angle_axis, force_axis, bar_axis), standing, trace in zip(
            axes, standings, traces, strict=True
        ):
            excerpt = _from_upward_reversal(trace)
            angle_axis.set_title(plain(standing.contestant))
            _draw_angles(angle_axis, excerpt, amplitude)
            _draw_force(force_axis, standing, excerpt, limits, unit)
            if has_best:
                _draw_relative_thrust(bar_axis, standing)
            else:
                _draw_thrust(bar_axis, standing, largest)
            _describe(bar_axis, standing, unit)
        for axis in axes[:-1].flat:
            axis.tick_params(labelbottom=False)
        for axis in axes[-1][:2]:
            axis.set_xlabel("time (s)")
        label = "% of the best\nsquare wave" if has_best else f"m{unit}"
        axes[-1][2].set_xlabel(label)
        legends = [axis.get_legend_handles_labels() for axis in axes[0]]
        handles, labels = ([item for pair in legends for item in pair[k]] for k in (0, 1))
        figure.legend(handles, labels, loc="outside lower left", ncols=3)


def draw_survey(path: str | os.PathLike[str], surveys: Sequence[ContestantSurvey]) -> None:
    """Draw a row for each fish, and in it a mark for each contestant; raises `FishdError`."""
    names = [result.fish for result in surveys[0].fish]
    with open_figure(path, (6.4, 1.1 + 0.2 * len(names))) as figure:
        axis = figure.subplots()
        for place, surveyed in enumerate(surveys):
            axis.plot(
                [100.0 * result.relative_thrust for result in surveyed.fish],
                range(len(names)),
                linestyle="",
                marker=_MARKERS[place % len(_MARKERS)],
                color=_COLOURS[place % len(_COLOURS)],
                alpha=0.8,
                label=plain(surveyed.contestant),
            )
        axis.axvline(100.0, color=GREY, linewidth=0.7, linestyle="--")
        axis.set_yticks(range(len(names)), names)
        axis.invert_yaxis()
        axis.grid(axis="y", color="0.9", linewidth=0.5)
        axis.set_xlabel("thrust, % of the best square wave of the same fish")
        figure.legend(loc="outside lower center", ncols=2)


def _from_upward_reversal(trace: Trace) -> Trace:
    """Return `TRACE_S` seconds from an upward reversal of the command on, for comparison."""
    turns = upward_reversals(trace.command)
    earliest = trace.time[0] + max(0.0, -trace.time[0] - TRACE_S)
    first = next((k for k in turns if trace.time[k] <= earliest + 1e-9), 0)
    begin = trace.time[first]
    last = max(k for k, time in enumerate(trace.time) if time <= begin + TRACE_S + 1e-9)
    chosen = slice(first, last + 1)
    times = [time - begin for time in trace.time[chosen]]
    return Trace(times, trace.command[chosen], trace.thrust[chosen], trace.fin[chosen])


def _draw_angles(axis: Any, trace: Trace, amplitude: float) -> None:
    # Not as a step plot, which would show the command after the last time.
    line = {"color": BLACK, "linewidth": 0.9, "label": "command $φ_c$"}
    axis.stairs(trace.command[:-1], trace.time, baseline=None, **line)
    if not any(map(math.isnan, trace.fin)):
        axis.plot(trace.time, trace.fin, color=ORANGE, linewidth=1.0, label="fin angle α")
    axis.set_ylim(-1.15 * amplitude, 1.15 * amplitude)
    axis.set_yticks((-amplitude, 0.0, amplitude), ("−Φ", "0", "Φ"))
    axis.set_xlim(0.0, trace.time[-1])
    axis.set_ylabel(f"angle\n(Φ = {amplitude:g} rad)")


def _draw_force(
    axis: Any, standing: Standing, trace: Trace, limits: tuple[float, float], unit: str
) -> None:
    thrust = 1e3 * np.array(trace.thrust)
    axis.axhline(0.0, color="0.8", linewidth=0.6)
    axis.plot(trace.time, thrust, color=BLUE, linewidth=0.9, label=_FORCES[bool(standing.runs)])
    label = _THRUSTS[bool(standing.runs)] + _of_runs(", mean", standing)
    mean = 1e3 * standing.thrust
    axis.axhline(mean, color=BLUE, linewidth=0.7, linestyle="--", label=label)
    axis.set_ylim(limits)
    axis.set_xlim(0.0, trace.time[-1])
    axis.set_ylabel(f"$F_x$ (m{unit})")


def _draw_relative_thrust(axis: Any, standing: Standing) -> None:
    percentages = [100.0 * run.relative_thrust for run in standing.runs]
    value = sum(percentages) / len(percentages)
    label = "relative thrust" + _of_runs(", mean", standing)
    whisker = _of_runs("lowest to highest", standing)
    _draw_bar(axis, label, value, value - min(percentages), max(percentages) - value, whisker)
    axis.set_xlim(0.0, max(105.0, 1.02 * max(percentages)))


def _draw_thrust(axis: Any, standing: Standing, largest: float) -> None:
    value, error = 1e3 * standing.thrust, 1e3 * (standing.thrust_ci95 or 0.0)
    _draw_bar(axis, "thrust", value, error, error, "95 %, statistical")
    low = min(0.0, 1.05 * (value - error))
    axis.set_xlim(low, 1.05e3 * max(largest, 1e-9))


def _draw_bar(
    axis: Any, label: str, value: float, below: float, above: float, whisker: str
) -> None:
    """Draw a bar with its value, and with a whisker if `whisker`, its label, is not empty."""
    axis.barh(0.0, value, height=0.45, color="0.75", label=label)
    if whisker:
        style = {"fmt": "none", "ecolor": _WHISKER_GREY, "elinewidth": 0.8, "capsize": 2}
        axis.errorbar(value, 0.0, xerr=[[below], [above]], label=whisker, **style)
    axis.text(0.02, 0.0, f"{value:.1f}", va="center", fontsize=8, transform=_across(axis))
    axis.set_ylim(-1.0, 0.4)
    axis.set_yticks(())
    axis.spines["left"].set_visible(False)


def _describe(axis: Any, standing: Standing, unit: str) -> None:
    thrust = text.format_measured(standing.thrust, standing.known_ci95, unit)
    caption = (
        f"{thrust}, {standing.frequency:.2f} Hz\n"
        f"$|φ_c|/Φ$ {standing.fullness:.2f}, form factor {standing.form_factor:.2f}"
    )
    style = {"va": "top", "fontsize": 6, "color": "0.35", "transform": _across(axis)}
    axis.text(0.0, -0.34, caption, **style)


def _across(axis: Any) -> Any:
    """Return the transform with x as a fraction of the width and y in data coordinates."""
    return axis.get_yaxis_transform()


def _of_runs(what: str, standing: Standing) -> str:
    """Return `what` with the number of runs; empty for a single run."""
    runs = len(standing.thrusts)
    return f"{what} of {runs} runs" if runs > 1 else ""
