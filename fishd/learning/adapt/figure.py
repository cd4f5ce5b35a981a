"""The picture of an adaptation: fit, search, training and comparison."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fishd.lab.drawing import BLACK, BLUE, GREEN, GREY, ORANGE, open_figure, save
from fishd.lab.identification.fit import LOGARITHMIC
from fishd.learning.adapt.results import SQUARE, TRAINING, Adapted, Fitted
from fishd.learning.run_folder.figure import draw_training
from fishd.virtual.plant.optimum import square_wave

_COLOURS = {"policy": BLUE, "swing": GREEN, SQUARE: ORANGE}


def draw(paths: Sequence[Path], adapted: Adapted, folder: Path, amplitude: float) -> None:
    """Draw fit, search, training and comparison into files, a panel each.

    folder: that of the adaptation, for the training; amplitude: Φ [rad]
    Raises `FishdError` where a file cannot be written.
    """
    with open_figure(paths[0], (10.0, 7.0)) as figure:
        (fit, search), (training, contest) = figure.subplots(2, 2)
        _draw_fit(fit, adapted.fitted)
        _draw_search(search, adapted, amplitude)
        draw_training(training, folder / (adapted.trained.folder or TRAINING))
        _draw_contest(contest, adapted)
        for path in paths[1:]:
            save(figure, path)


def _draw_fit(axis: Any, fitted: Fitted) -> None:
    """Draw the intervals of the parameters that are fitted as logarithms, as in the page's table.

    Others may be near zero, so they have no relative error. Where an interval is narrower if K_y/K
    is the configured one, that is drawn over it. One that is withheld has no bar.
    """
    shown = [
        (name, estimate)
        for name, estimate in fitted.identification["estimates"].items()
        if estimate.get("fitted", True) and name in LOGARITHMIC and name != "lateral_inertia_ratio"
    ]
    bars = {}
    for place, (_, estimate) in enumerate(shown):
        whole = estimate["ci95_low"], estimate["ci95_high"]
        narrow = estimate.get("if_ratio_holds") or (None, None)
        for (low, high), colour, label in (
            (whole, GREY, "95 %"),
            (narrow, BLUE, "95 %, if K_y/K is as configured"),
        ):
            if low is not None and high is not None:
                ends = [100.0 * (end / estimate["value"] - 1.0) for end in (low, high)]
                bars[label] = axis.barh(
                    -place, ends[1] - ends[0], left=ends[0], color=colour, height=0.6
                )
    axis.legend(bars.values(), bars, fontsize="small", loc="upper right")
    axis.set_yticks([-place for place in range(len(shown))], [name for name, _ in shown])
    axis.set_xscale("symlog", linthresh=1.0)
    axis.set_xlabel("95 % interval, % from the value")
    axis.set_title("the fish, as fitted")


def _draw_search(axis: Any, adapted: Adapted, amplitude: float) -> None:
    """Draw the tried square waves, and those of the identified fish."""
    waves = adapted.waves
    tried = [wave.frequency for wave in waves]
    frequencies = np.geomspace(0.9 * min(tried), 1.1 * max(tried), 60)
    curves = [
        [1e3 * square_wave(plant, amplitude, f).thrust for f in frequencies.tolist()]
        for plant in adapted.fitted.cloud[:8]
    ]
    for curve in curves[1:]:
        axis.plot(frequencies, curve, color=GREY, linewidth=0.6)
    if curves:
        axis.plot(frequencies, curves[0], color=BLACK, label="identified fish, and its cloud")
    axis.errorbar(
        tried, [1e3 * wave.thrust for wave in waves],
        yerr=[1e3 * wave.thrust_ci95 for wave in waves], fmt="o", color=ORANGE,
        markersize=4, elinewidth=0.8, capsize=2, label="tried, 95 %",
    )  # fmt: skip
    axis.set_xlabel("frequency (Hz)")
    axis.set_ylabel("thrust (mN)")
    axis.set_title("square waves")
    axis.legend(loc="upper right")


def _draw_contest(axis: Any, adapted: Adapted) -> None:
    """Draw the thrusts measured on the fish."""
    for place, gait in enumerate(adapted.gaits):
        axis.errorbar(
            1e3 * gait.thrust, -place, xerr=1e3 * (gait.thrust_ci95 or 0.0), fmt="o", capsize=3,
            color=_COLOURS[gait.contestant],
        )  # fmt: skip
        if gait.contestant in adapted.true_thrusts:
            true = 1e3 * adapted.true_thrusts[gait.contestant]
            axis.plot(true, -place, "x", color=BLACK, zorder=3)
    places = range(0, -len(adapted.gaits), -1)
    axis.set_yticks(places, [gait.contestant for gait in adapted.gaits])
    axis.set_ylim(0.5 - len(adapted.gaits), 0.5)
    known = "; ×: true" if adapted.true_thrusts else ""
    axis.set_xlabel(f"thrust, measured, 95 % statistical (mN){known}")
    axis.set_title("in the tank")
