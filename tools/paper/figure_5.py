"""Figure 5: relative thrust of swinging control against ω₀Φ/Ω; inset: with a fast servo."""

import numpy as np

from fishd.config import Config
from fishd.lab import drawing
from fishd.lab.drawing import BLACK, BLUE, GREEN, ORANGE, PURPLE
from fishd.lab.optimum import saturation_amplitude
from fishd.virtual.plant.parameters import PlantParameters
from paper import swing_map
from paper.runs import (
    FINE_TICK,
    FOLDER,
    PERFECT,
    PLANT,
    TRUE_VELOCITY,
    Run,
    column,
    read,
    swim_all,
    write,
)

NAME, INSET = "figure-5", "figure-5-inset"
CRITERIA = (0.0, 0.2, 0.4, 0.6, 0.8)
RATIOS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.2, 1.5, 2.0, 2.5, 3.0, 3.35)
SECONDS, SETTLE = 26.0, 6.0
DAMPINGS = (0.05, 1.2)
INSET_CRITERIA = tuple(tenths / 10 for tenths in range(10))
INSET_AMPLITUDE = 0.1
INSET_SECONDS, INSET_SETTLE = 50.0, 30.0


def run(criterion: float, ratio: float) -> Run:
    """Return a run with the true fin velocity, at a tick that represents continuous time."""
    amplitude = ratio * saturation_amplitude(PLANT)
    config = Config(
        amplitude_limit=amplitude, tick=FINE_TICK, simulation=PERFECT, estimator=TRUE_VELOCITY
    )
    return Run("swing", {"C": criterion}, config, SECONDS, SETTLE)


def inset_run(xi: float, criterion: float) -> Run:
    """Return a run like that of `run`, with a wheel that follows at once."""
    config = Config(
        amplitude_limit=INSET_AMPLITUDE,
        tick=FINE_TICK,
        simulation=PERFECT,
        estimator=TRUE_VELOCITY,
        plant=PlantParameters(xi=xi, servo_speed=1e3, servo_lag=1e-3),
    )
    return Run("swing", {"C": criterion}, config, INSET_SECONDS, INSET_SETTLE)


def compute(jobs: int) -> None:
    """Compute every C at every ω₀Φ/Ω, and with fast servos."""
    cases = [(criterion, ratio) for criterion in CRITERIA for ratio in RATIOS]
    fast = [(xi, criterion) for xi in DAMPINGS for criterion in INSET_CRITERIA]
    runs = [run(*case) for case in cases] + [inset_run(*case) for case in fast]
    reports = swim_all(runs, jobs)
    write(
        NAME,
        [
            {
                "C": c,
                "w0Phi_over_Omega": x,
                "relative_thrust": r.relative_thrust,
                "frequency_Hz": r.frequency,
            }
            for (c, x), r in zip(cases, reports[: len(cases)], strict=True)
        ],
    )
    write(
        INSET,
        [
            {"xi": xi, "C": c, "relative_thrust": r.relative_thrust, "frequency_Hz": r.frequency}
            for (xi, c), r in zip(fast, reports[len(cases) :], strict=True)
        ],
    )


def draw() -> None:
    """Draw lines for continuous time, points for the robot's tick and an imperfect sensor."""
    styles = zip(
        CRITERIA,
        (PURPLE, GREEN, BLUE, BLACK, ORANGE),
        ((0, (1, 1)), (0, (3, 1, 1, 1)), (0, (5, 2)), "-", (0, (7, 2, 1, 2))),
        "v^osD",
        strict=True,
    )
    with drawing.open_figure(FOLDER / f"{NAME}.svg", (7.2, 4.6)) as figure:
        axes = figure.subplots()
        for criterion, colour, line, marker in styles:
            rows = read(NAME, C=criterion)
            x, y = column(rows, "w0Phi_over_Omega"), np.array(column(rows, "relative_thrust"))
            axes.plot(x, 100 * y, color=colour, ls=line)
            rows = read(swing_map.NAME, C=criterion)
            x, y = column(rows, "w0Phi_over_Omega"), np.array(column(rows, "median"))
            points = {"color": colour, "marker": marker, "mfc": "white", "mew": 1.0}
            axes.plot(x, 100 * y, ls="", **points)
            axes.plot([], [], ls=line, label=f"C = {criterion:g}", **points)
        axes.set_xlim(0.0, 3.4)
        axes.set_ylim(0.0, 103.0)
        axes.set_xlabel("ω₀Φ/Ω (1)")
        axes.set_ylabel("thrust over that of the best square wave (%)")
        axes.legend(
            loc="lower left",
            title="lines: true fin velocity, 5 ms tick\npoints: the robot's loop, 50 ms tick",
            alignment="left",
            title_fontsize=8,
            handlelength=3,
        )
        inset = axes.inset_axes((0.52, 0.1, 0.45, 0.42))
        for xi, line in zip(DAMPINGS, ("-", (0, (4, 2))), strict=True):
            rows = read(INSET, xi=xi)
            inset.plot(
                column(rows, "C"), 100 * np.array(column(rows, "relative_thrust")), color=BLACK,
                ls=line,
                label=f"ξ = {xi:g}",
            )  # fmt: skip
        inset.set_xlim(0.0, 0.9)
        inset.set_ylim(0.0, 103.0)
        inset.set_xlabel("C (1)", labelpad=1)
        inset.set_ylabel("%", labelpad=0)
        inset.set_title("fast servo", fontweight="normal")
        inset.legend(loc="lower left")
