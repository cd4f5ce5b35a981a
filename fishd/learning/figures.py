"""Pictures of what was learned: traces of contestants side by side, learning curves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fishd.errors import FishdError
from fishd.learning.comparison import TRACE, Standing, Trace

_COMMAND, _FORCE, _FIN = "#1a1a1a", "#0072b2", "#d55e00"
_CURVES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
_FIRST, _TICKS = 200, (200, 500, 1000, 2000, 5000, 10_000, 20_000)
"""Control steps."""
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
        limits = min(0.0, *forces) - 2.0, 1.08 * max(forces)
        for axis, title in zip(axes[0], (None, "measured force", "efficiency (%)"), strict=True):
            axis.set_title(title or "", loc="left", fontsize=8)
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
        figure.legend(
            *axes[0][0].get_legend_handles_labels(), loc="outside lower left", ncols=2, fontsize=7
        )
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
        axis.axhline(100.0 * goal, color="0.6", linewidth=0.6, linestyle=(0, (4, 3)))
        for color, (label, seeds) in zip(_CURVES, curves.items(), strict=False):
            steps = np.array(seeds[0][0])
            efficiency = 100.0 * np.array([efficiencies for _, efficiencies in seeds])
            axis.fill_between(
                steps, efficiency.min(0), efficiency.max(0), color=color, alpha=0.15, linewidth=0
            )
            axis.plot(steps, np.median(efficiency, 0), color=color, linewidth=1.4, label=label)
        axis.set_xscale("log")
        axis.set_xlim(_FIRST, steps_shown)
        ticks = [tick for tick in _TICKS if _FIRST <= tick <= steps_shown]
        axis.set_xticks(ticks, [f"{tick:,}".replace(",", " ") for tick in ticks])
        axis.minorticks_off()
        axis.set_ylim(60, 101)
        axis.set_xlabel("control steps")
        axis.set_ylabel("efficiency (% of the best square wave)")
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
    axis.step(
        trace.time, trace.command, where="post", color=_COMMAND, linewidth=0.9, label="command"
    )
    axis.plot(trace.time, trace.fin, color=_FIN, linewidth=1.0, label="fin")
    axis.set_ylim(-1.15 * amplitude, 1.15 * amplitude)
    axis.set_yticks((-amplitude, 0.0, amplitude), ("−Φ", "0", "Φ"))
    axis.set_xlim(0.0, trace.time[-1])
    axis.set_ylabel("angle")


def _draw_force(axis: Any, standing: Standing, trace: Trace, limits: tuple[float, float]) -> None:
    thrust = 1e3 * np.array(trace.thrust)
    axis.axhline(0.0, color="0.8", linewidth=0.6)
    axis.plot(trace.time, thrust, color=_FORCE, linewidth=0.9)
    mean = 1e3 * standing.thrust
    axis.axhline(mean, color=_FORCE, linewidth=0.7, linestyle=(0, (4, 3)))
    axis.set_ylim(limits[0] - 2.0, 1.08 * limits[1])
    axis.set_xlim(0.0, trace.time[-1])
    axis.set_ylabel("$F_x$ (mN)")


def _draw_bar(axis: Any, standing: Standing) -> None:
    value = 100.0 * standing.efficiency
    low, high = 100.0 * standing.lowest_efficiency, 100.0 * standing.highest_efficiency
    axis.barh(0.0, value, height=0.45, color="0.75")
    axis.errorbar(
        value, 0.0, xerr=[[value - low], [high - value]], color="0.2", linewidth=0.8, capsize=2
    )
    axis.text(2.0, 0.0, f"{value:.1f}", va="center", fontsize=8)
    axis.text(
        0.0,
        -0.62,
        f"{standing.frequency:.2f} Hz, full {standing.fullness:.2f}, "
        f"square {standing.squareness:.2f}",
        va="center",
        fontsize=6,
        color="0.35",
    )
    axis.set_xlim(0.0, 105.0)
    axis.set_ylim(-0.85, 0.6)
    axis.set_yticks(())
    axis.spines["left"].set_visible(False)


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
