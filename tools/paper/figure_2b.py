"""Figure 2B: the best command at Φ = 0.31 rad, with the motion of the fin and the thrust."""

import joblib
import numpy as np

from fishd.config import Config
from fishd.core.signals import Event, Tick
from fishd.lab import drawing
from fishd.lab.drawing import BLACK, BLUE, ORANGE
from fishd.lab.optimum import best_square_waves, figure, optimal_control
from fishd.lab.simulation import VirtualRun
from fishd.virtual.plant.parameters import PlantParameters
from paper.runs import FINE_TICK, FOLDER, PERFECT, PLANT, column, read, write

NAME, CASES = "figure-2b", "optimal-control"
AMPLITUDE = 0.31
"""Amplitude Φ [rad]."""
SHOWN = 0.42
"""Φ of the picture in docs/explanation/optimum.md [rad]."""
REFERENCES = [(xi, amplitude) for xi in (1.2, 0.05) for amplitude in (0.1, 0.31, 0.42, 1.0, 1.4)]
"""ξ and Φ for which the best command of any shape is computed."""
SETTLE, BEATS = 10.0, 2


class _Fins:
    """Publisher that stores the fin angle."""

    def __init__(self) -> None:
        self.angles: list[float] = []

    def tick(self, tick: Tick) -> None:
        assert isinstance(tick.alpha, float)
        self.angles.append(tick.alpha)

    def event(self, event: Event) -> None:
        pass


def compute(jobs: int) -> None:
    """Compute the traces of the loop and of optimal control, and its reference cases."""
    controls = joblib.Parallel(jobs)(
        joblib.delayed(optimal_control)(PlantParameters(xi=xi), phi) for xi, phi in REFERENCES
    )
    cases = [
        {
            "xi": xi,
            "amplitude_rad": control.amplitude,
            "thrust_mN": 1e3 * control.thrust,
            "frequency_Hz": control.frequency,
            "best_square_thrust_mN": 1e3 * control.best_square.thrust,
            "best_square_frequency_Hz": control.best_square.frequency,
            "thrust_over_best_square": control.ratio,
            "share_of_time_at_limit": control.saturated_fraction,
            "share_of_time_on_side_of_costate": control.costate_agreement,
        }
        for (xi, _), control in zip(REFERENCES, controls, strict=True)
    ]
    write(CASES, cases)
    figure.draw(controls[REFERENCES.index((PLANT.xi, SHOWN))], FOLDER / f"{CASES}.svg")
    control = controls[REFERENCES.index((PLANT.xi, AMPLITUDE))]
    rows = [("optimal control", *_each(control.time, control))]
    for beat in range(1, BEATS):
        rows.append(("optimal control", *_each(control.time + beat * control.period, control)))
    rows.append(("loop", *_swum()))
    names = ("time_s", "command_rad", "fin_rad", "thrust_mN")
    write(
        NAME,
        [
            {"source": source, **dict(zip(names, map(float, values), strict=True))}
            for source, *columns in rows
            for values in zip(*columns, strict=True)
        ],
    )


def _each(time, control):  # type: ignore[no-untyped-def]
    return time, control.command, control.fin, 1e3 * control.force


def _swum() -> tuple[list[float], ...]:
    """Return the best square wave in the loop: time (s), command, fin (rad), thrust (mN)."""
    best = best_square_waves(PLANT, [AMPLITUDE])
    fins = _Fins()
    commands, thrusts, sides = [], [], []
    with VirtualRun(
        Config(amplitude_limit=AMPLITUDE, tick=FINE_TICK, simulation=PERFECT), fins
    ) as run:
        run.set_controller("square", {"frequency": float(best.frequency[0])})
        reversals = first = 0
        while reversals <= BEATS:
            commands.append(run.loop.instruction_angle)
            thrusts.append(1e3 * run.tick().thrust)
            sides.append(commands[-1] > 0.0)
            up = len(sides) > 1 and sides[-1] and not sides[-2]
            if up and len(commands) * FINE_TICK > SETTLE:
                reversals += 1
                first = len(commands) - 1 if reversals == 1 else first
    shown = slice(first, len(commands) - 1)
    before = slice(first - 1, len(commands) - 2)
    times = [FINE_TICK * k for k in range(len(commands) - 1 - first)]
    return times, commands[shown], fins.angles[before], thrusts[shown]


def draw() -> None:
    """Draw command, fin and thrust; lines from the loop, dots from optimal control."""
    loop, control = read(NAME, source="loop"), read(NAME, source="optimal control")
    with drawing.open_figure(FOLDER / f"{NAME}.svg", (6.0, 4.8)) as drawn:
        panels = drawn.subplots(3, 1, sharex=True)
        shown = (
            ("command_rad", "command $φ_c$ (rad)", BLACK),
            ("fin_rad", "fin angle $α$ (rad)", ORANGE),
            ("thrust_mN", "thrust $F_x$ (mN)", BLUE),
        )
        time, sparse = np.array(column(loop, "time_s")), control[::8]
        for axes, (name, label, colour) in zip(panels, shown, strict=True):
            values = column(loop, name)
            axes.axhline(0.0, color="0.85", lw=0.7)
            if name == "fin_rad":
                axes.plot(time, values, color=colour)
            else:
                axes.stairs(values, [*time, time[-1] + FINE_TICK], baseline=None, color=colour)
            axes.plot(
                column(sparse, "time_s"), column(sparse, name), "o", ms=3.5,
                mfc="white", mec=colour, mew=0.9,
            )  # fmt: skip
            axes.set_ylabel(label)
        panels[0].set_ylim(-1.2 * AMPLITUDE, 1.2 * AMPLITUDE)
        panels[-1].set_xlabel("time (s)")
        panels[-1].set_xlim(0.0, float(time[-1]) + FINE_TICK)
        panels[0].set_title(
            "lines: best square wave in the loop; dots: optimal control of any shape",
            fontweight="normal",
        )
