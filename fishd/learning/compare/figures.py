"""Pictures of what was learned: traces of contestants side by side, learning curves."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from fishd.errors import FishdError
from fishd.learning.comparison import TRACE, Standing, Trace

_COMMAND, _FORCE, _FIN = "#1a1a1a", "#0072b2", "#d55e00"
_SPREAD = "0.2"
_DASHED = (0, (4, 3))
_CURVES = (
    ("#0072b2", "-", 2.6),
    ("#d55e00", (0, (3, 1.5)), 1.4),
    ("#009e73", "-", 1.2),
    ("#cc79a7", (0, (1, 1)), 1.6),
    ("#000000", (0, (6, 1.5, 1, 1.5)), 1.1),
    ("#e69f00", "-", 0.9),
)
"""Colour (Okabe and Ito's, which the colour-blind can tell apart), line style, width [points].
Later ones are thinner or have gaps, so that an earlier one with the same course is still seen."""
_FIRST, _TICKS = 200, (200, 500, 1000, 2000, 5000, 10_000, 20_000)
"""Control steps."""
_LOWEST = 60
"""Efficiency at which the axis begins [%]."""
_STYLE = {
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
}


def picture(
    path: Path, standings: Sequence[Standing], traces: Sequence[Trace], amplitude: float
) -> None:
    """Command, fin and force at the end of each contestant's run, and a bar of its efficiency.

    amplitude: Φ [rad]. Raises `FishdError` where matplotlib is missing or the file cannot be made.
    """
    plt = _pyplot()
    rows = len(standings)
    with plt.rc_context(_STYLE):
        figure, axes = plt.subplots(
            rows,
            3,
            figsize=(7.2, 0.55 + 1.15 * rows),
            width_ratios=(3, 3, 1.6),
            squeeze=False,
            layout="constrained",
        )
        forces = [1e3 * force for trace in traces for force in trace.thrust]
        limits = min(0.0, *forces) - 4.0, 1.15 * max(0.0, *forces) + 1.0
        for axis, title in zip(axes[0], ("", "force", "efficiency"), strict=True):
            axis.set_title(title, loc="left", fontsize=8)
        for drawn, standing, trace in zip(axes, standings, traces, strict=True):
            shown = _from_upward_reversal(trace)
            _draw_angles(drawn[0], shown, amplitude)
            _draw_force(drawn[1], standing, shown, limits)
            _draw_bar(drawn[2], standing)
            drawn[0].set_title(standing.contestant, loc="left", fontsize=8, fontweight="bold")
        for axis in axes[:-1].flat:
            axis.tick_params(labelbottom=False)
        for axis in axes[-1][:2]:
            axis.set_xlabel("time (s)")
        axes[-1][2].set_xlabel("% of the best square wave", fontsize=7)
        named = [axis.get_legend_handles_labels() for axis in axes[0]]
        handles, labels = ([one for pair in named for one in pair[k]] for k in (0, 1))
        figure.legend(handles, labels, loc="outside lower left", ncols=3, fontsize=7)
        _save(plt, figure, path)


def learning_curves(
    path: Path, curves: Mapping[str, Sequence[tuple[Sequence[int], Sequence[float]]]], goal: float
) -> None:
    """Efficiency against steps: median and range of the seeds of each training.

    curves: for each training its seeds, each as steps and efficiencies
    goal: drawn as a line
    Raises `FishdError` where matplotlib is missing or the file cannot be made.
    """
    plt = _pyplot()
    steps_shown = max(seeds[0][0][-1] for seeds in curves.values())
    with plt.rc_context(_STYLE):
        figure, axis = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
        for (color, style, width), (label, seeds) in zip(cycle(_CURVES), curves.items()):
            steps = np.array(seeds[0][0])
            efficiency = 100.0 * np.array([efficiencies for _, efficiencies in seeds])
            low, high = efficiency.min(0), efficiency.max(0)
            axis.fill_between(steps, low, high, color=color, alpha=0.1, linewidth=0)
            for edge in (low, high):
                axis.plot(steps, edge, color=color, linestyle=style, linewidth=0.5, alpha=0.6)
            middle = np.median(efficiency, 0)
            axis.plot(steps, middle, color=color, linestyle=style, linewidth=width, label=label)
        axis.axhline(
            100.0 * goal,
            color="0.45",
            linewidth=0.7,
            linestyle=_DASHED,
            label=f"{100.0 * goal:.0f} %",
        )
        axis.set_xscale("log")
        axis.set_xlim(_FIRST, steps_shown)
        ticks = [tick for tick in _TICKS if _FIRST <= tick <= steps_shown]
        axis.set_xticks(ticks, [f"{tick:,}".replace(",", " ") for tick in ticks])
        axis.minorticks_off()
        axis.set_ylim(_LOWEST, 101)
        axis.set_xlabel("control steps")
        axis.set_ylabel(f"efficiency (% of the best square wave, from {_LOWEST} % up)")
        figure.legend(loc="outside lower center", ncols=3, fontsize=7)
        _save(plt, figure, path)


def _from_upward_reversal(trace: Trace) -> Trace:
    """`TRACE` seconds of it, from where the command turns upward: contestants can be compared."""
    command = trace.command
    turns = [k for k in range(1, len(command)) if command[k - 1] <= 0.0 < command[k]]
    earliest = trace.time[0] + max(0.0, -trace.time[0] - TRACE)
    first = next((k for k in turns if trace.time[k] <= earliest + 1e-9), 0)
    begin = trace.time[first]
    last = max(k for k, time in enumerate(trace.time) if time <= begin + TRACE + 1e-9)
    chosen = slice(first, last + 1)
    times = [time - begin for time in trace.time[chosen]]
    return Trace(times, command[chosen], trace.thrust[chosen], trace.fin[chosen])


def _draw_angles(axis: Any, trace: Trace, amplitude: float) -> None:
    # Not as a step plot: it would turn to the command after the last time shown.
    axis.stairs(
        trace.command[:-1],
        trace.time,
        baseline=None,
        color=_COMMAND,
        linewidth=0.9,
        label="command $φ_c$",
    )
    axis.plot(trace.time, trace.fin, color=_FIN, linewidth=1.0, label="fin angle α")
    axis.set_ylim(-1.15 * amplitude, 1.15 * amplitude)
    axis.set_yticks((-amplitude, 0.0, amplitude), ("−Φ", "0", "Φ"))
    axis.set_xlim(0.0, trace.time[-1])
    axis.set_ylabel(f"angle\n(Φ = {amplitude:g} rad)")


def _draw_force(axis: Any, standing: Standing, trace: Trace, limits: tuple[float, float]) -> None:
    thrust = 1e3 * np.array(trace.thrust)
    axis.axhline(0.0, color="0.8", linewidth=0.6)
    axis.plot(trace.time, thrust, color=_FORCE, linewidth=0.9, label="$F_x$ as measured")
    axis.axhline(
        1e3 * standing.thrust,
        color=_FORCE,
        linewidth=0.7,
        linestyle=_DASHED,
        label="true mean $F_x$" + _of_runs(", median", standing),
    )
    axis.set_ylim(limits)
    axis.set_xlim(0.0, trace.time[-1])
    axis.set_ylabel("$F_x$ (mN)")


def _draw_bar(axis: Any, standing: Standing) -> None:
    value = 100.0 * standing.efficiency
    low, high = 100.0 * standing.lowest_efficiency, 100.0 * standing.highest_efficiency
    label = "efficiency" + _of_runs(", median", standing)
    axis.barh(0.0, value, height=0.45, color="0.75", label=label)
    if len(standing.runs) > 1:
        axis.errorbar(
            value,
            0.0,
            xerr=[[value - low], [high - value]],
            fmt="none",
            ecolor=_SPREAD,
            elinewidth=0.8,
            capsize=2,
            label=_of_runs("lowest to highest", standing),
        )
    axis.text(2.0, 0.0, f"{value:.1f}", va="center", fontsize=8)
    axis.text(
        0.0,
        -0.34,
        f"{standing.frequency:.2f} Hz\n$|φ_c|/Φ$ {standing.fullness:.2f}, "
        f"square {standing.squareness:.2f}",
        va="top",
        fontsize=6,
        color="0.35",
    )
    axis.set_xlim(0.0, max(105.0, 1.02 * high))
    axis.set_ylim(-1.0, 0.4)
    axis.set_yticks(())
    axis.spines["left"].set_visible(False)


def _of_runs(what: str, standing: Standing) -> str:
    """`what` and of how many runs; nothing where there is only one."""
    runs = len(standing.runs)
    return f"{what} of {runs} runs" if runs > 1 else ""


def _pyplot() -> Any:
    try:
        import matplotlib
    except ModuleNotFoundError:
        raise FishdError(
            "a picture needs matplotlib, which is not installed: pip install 'fishd[lab]'"
        ) from None
    matplotlib.use("agg")
    from matplotlib import pyplot

    return pyplot


def _save(plt: Any, figure: Any, path: Path) -> None:
    try:
        figure.savefig(path, dpi=200)
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise FishdError(f"{path}: the picture cannot be written: {why}") from None
    finally:
        plt.close(figure)
