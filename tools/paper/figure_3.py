"""Figure 3, A to C: thrust, frequency and fin amplitude of the optimum against Φ."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from common.report import DOCS
from fishd.camera.simulated import SimulatedCamera, SimulatedCameraSettings, Tail
from fishd.camera.tail.beats import average, find_maxima
from fishd.camera.tail.learner import Learner
from fishd.camera.tail.meter import TailMeter
from fishd.config import Config
from fishd.core.camera_frames import Frame
from fishd.core.signals import Tick
from fishd.lab import drawing
from fishd.lab.drawing import BLACK, BLUE, GREY, ORANGE, YELLOW
from fishd.lab.optimum import best_square_waves, fast_servo, saturation_amplitude, slow_servo
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import Report
from paper.runs import FOLDER, PLANT, Row, Run, column, read, swim_all, write

NAME = "figure-3"
AMPLITUDES = (0.05, 0.1, 0.2, 0.31, 0.42, 0.63, 0.8, 1.0, 1.4)
LEARNED = (0.1, 0.2, 0.31, 0.42, 0.63, 0.8, 1.0, 1.4)
NEAR = np.linspace(0.8, 1.2, 13)
"""Frequencies in the loop, relative to the best one of the equations."""
SECONDS, SETTLE = 40.0, 10.0
RANGE = (0.04, 1.57)
BY_SIGHT = (0.1, 0.2, 0.31, 0.42, 0.63, 0.8, 1.0, 1.4)
"""Amplitudes of the policies that learned from pictures only."""
BEST, FAST, SLOW = "best square wave", "fast servo", "slow servo"
LOOP, SWING, LEARNT = "square wave in the loop", "swing in the loop", "learned, in the loop"
SEEN = "learned from pictures, in the loop"
FILMED = (0.2, 0.31, 0.42, 0.8, 1.4)
"""Amplitudes of the square waves whose fin angle a simulated camera measures."""
MEASURED = "square wave, fin angle measured by a simulated camera"


def policy(amplitude: float) -> str:
    """Return the policy for an amplitude [rad]."""
    return str(DOCS / "figures" / "policies" / f"amplitude-{amplitude:.2f}.onnx")


def sighted_policy(amplitude: float) -> str:
    """Return the policy from pictures for an amplitude [rad]."""
    return str(DOCS / "figures" / "policies" / f"sight-{amplitude:.2f}.onnx")


def run(controller: str, parameters: dict[str, float | str], amplitude: float) -> Run:
    """Return a run with ticks of 50 ms, the default estimator and 1 mN of noise."""
    return Run(controller, parameters, Config(amplitude_limit=amplitude), SECONDS, SETTLE)


def compute(jobs: int) -> None:
    """Compute curves from the equations, and points from the loop."""
    angles = np.geomspace(*RANGE, 50)
    rows: list[Row] = []
    for source, optima in (
        (BEST, best_square_waves(PLANT, angles)),
        (FAST, fast_servo(PLANT, angles)),
        (SLOW, slow_servo(PLANT, angles)),
    ):
        columns = (optima.amplitude, optima.thrust, optima.frequency, optima.fin_amplitude)
        rows += [_row(source, *values) for values in np.array(columns).T.tolist()]
    best = best_square_waves(PLANT, AMPLITUDES).frequency
    squares = swim_all(
        (
            run("square", {"frequency": float(factor * frequency)}, amplitude)
            for amplitude, frequency in zip(AMPLITUDES, best, strict=True)
            for factor in NEAR
        ),
        jobs,
    )
    for k in range(0, len(squares), len(NEAR)):
        rows.append(_of(LOOP, max(squares[k : k + len(NEAR)], key=lambda r: r.mean_thrust)))
    for row in [row for row in rows if row["source"] == LOOP and row["amplitude_rad"] in FILMED]:
        fin = measure_fin(float(row["amplitude_rad"]), float(row["frequency_Hz"]))
        rows.append(dict.fromkeys(row, "") | row | {"source": MEASURED, "fin_amplitude_rad": fin})
    swings = swim_all((run("swing", {"C": 0.6}, amplitude) for amplitude in AMPLITUDES), jobs)
    rows += [_of(SWING, report) for report in swings]
    learned = swim_all((run("ppo", {"policy": policy(a)}, a) for a in LEARNED), jobs)
    rows += [_of(LEARNT, report) for report in learned]
    seen = swim_all((run("ppo", {"policy": sighted_policy(a)}, a) for a in BY_SIGHT), jobs)
    rows += [_of(SEEN, report) for report in seen]
    write(NAME, rows)


def measure_fin(amplitude: float, frequency: float) -> float:
    """Return the mean of the largest fin angles of a square wave [rad].

    A simulated camera measures them. It learns the tail from a rest and a swim, and measures it in
    the next swim.
    """
    camera, learner = SimulatedCamera(SimulatedCameraSettings(rate=30.0), 640, 480), Learner()

    def film(ticks: list[Tick]) -> Iterator[Frame]:
        for before, after in pairwise(Tail(t.time, t.alpha, t.alpha_rate) for t in ticks):
            yield from camera.frames(before, after)

    with VirtualSession(Config(amplitude_limit=amplitude)) as fish:
        swim = "square", {"frequency": frequency}, 10.0
        for frame in film(fish.rest(3.0) + fish.swim(*swim)):
            learner.add(frame.time, frame.pixels)
        meter = TailMeter(learner.finish())
        readings = [meter.read(frame.time, frame.pixels) for frame in film(fish.swim(*swim))]
    beats = find_maxima([r.time for r in readings], [r.alpha for r in readings])
    mean = average(beats[2:])  # steady by then
    assert mean
    return mean[0]


def _of(source: str, report: Report) -> Row:
    return _row(
        source,
        report.amplitude,
        report.mean_thrust,
        report.frequency,
        report.fin_amplitude,
        report.relative_thrust,
        report.fullness,
    )


def _row(
    source: str, amplitude: float, thrust: float, frequency: float, fin: float, *judged: float
) -> Row:
    relative_thrust, fullness = judged or ("", "")
    return {
        "source": source,
        "amplitude_rad": amplitude,
        "thrust_mN": 1e3 * thrust,
        "frequency_Hz": frequency,
        "fin_amplitude_rad": fin,
        "relative_thrust": relative_thrust,
        "mean_command_over_limit": fullness,
    }


def draw() -> None:
    """Draw three panels side by side."""
    curves = (
        (BEST, {"color": BLACK, "lw": 1.6}),
        (FAST, {"color": GREY, "ls": (0, (4, 2))}),
        (SLOW, {"color": GREY, "ls": (0, (1, 1.5))}),
    )
    points = (
        (LOOP, {"marker": "s", "mec": BLUE, "mfc": "none", "ms": 6}),
        (SWING, {"marker": "x", "mec": BLACK, "ms": 5}),
        (LEARNT, {"marker": "o", "mec": ORANGE, "mfc": ORANGE, "ms": 3.5}),
        (SEEN, {"marker": "D", "mec": YELLOW, "mfc": "none", "ms": 6}),
    )
    panels = (
        ("A", "thrust_mN", "mean thrust (mN)", (0.2, 200)),
        ("B", "frequency_Hz", "frequency (Hz)", (0.8, 4)),
        ("C", "fin_amplitude_rad", "fin amplitude (rad)", (0.015, 1)),
    )
    with drawing.open_figure(FOLDER / f"{NAME}.svg", (9.6, 3.6)) as figure:
        for axes, (title, name, label, limits) in zip(figure.subplots(1, 3), panels, strict=True):
            axes.axvline(saturation_amplitude(PLANT), color="0.85", lw=0.8)
            for source, style in curves:
                rows = read(NAME, source=source)
                axes.plot(column(rows, "amplitude_rad"), column(rows, name), label=source, **style)
            for source, style in points:
                rows = read(NAME, source=source)
                axes.plot(
                    column(rows, "amplitude_rad"), column(rows, name), ls="", label=source, **style
                )
            if name == "fin_amplitude_rad":
                rows = read(NAME, source=MEASURED)
                angles, fins = column(rows, "amplitude_rad"), column(rows, name)
                axes.plot(angles, fins, "+", color=BLACK, ms=11, label=MEASURED)
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xlim(RANGE[0], 1.7)
            axes.set_ylim(limits)
            axes.set_xticks((0.05, 0.1, 0.2, 0.5, 1.0), ("0.05", "0.1", "0.2", "0.5", "1"))
            axes.set_xticks((), minor=True)
            axes.set_xlabel("amplitude Φ (rad)")
            axes.set_ylabel(label)
            axes.set_title(title)
            if name == "frequency_Hz":
                axes.set_yticks((1, 1.5, 2, 3, 4), ("1", "1.5", "2", "3", "4"))
                axes.set_yticks((), minor=True)
            else:
                ticks = (1, 10, 100) if name == "thrust_mN" else (0.02, 0.05, 0.1, 0.2, 0.5, 1)
                axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.text(saturation_amplitude(PLANT), limits[0], " $Φ_s$", va="bottom", color="0.4")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
