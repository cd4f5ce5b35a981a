"""Figure 4: the thrust of square, sine and triangle waves against frequency, at Φ = 0.42 rad."""

import numpy as np

from fishd.config import Config
from fishd.lab import drawing
from fishd.lab.drawing import BLACK, BLUE, ORANGE
from paper.runs import FINE_TICK, FOLDER, PERFECT, Run, column, read, swim_all, write

NAME = "figure-4"
AMPLITUDE = 0.42
WAVES = ("square", "sine", "triangle")
TICKS = {
    FINE_TICK: np.arange(2, 41) / 10,
    0.05: np.arange(1, 21) / 5,
}
"""Frequencies for each tick [Hz by s]."""
SETTLE, MIN_SECONDS, BEATS = 4.0, 10.0, 4


def run(wave: str, tick: float, frequency: float) -> Run:
    """Return a run without noise, which does not affect these controllers."""
    config = Config(amplitude_limit=AMPLITUDE, tick=tick, simulation=PERFECT)
    seconds = SETTLE + max(MIN_SECONDS, BEATS / frequency)
    return Run(wave, {"frequency": frequency}, config, seconds, SETTLE)


def compute(jobs: int) -> None:
    """Compute every waveform at every frequency, with a fine tick and with that of the robot."""
    cases = [
        (wave, tick, float(frequency))
        for tick, frequencies in TICKS.items()
        for wave in WAVES
        for frequency in frequencies
    ]
    reports = swim_all((run(*case) for case in cases), jobs)
    write(
        NAME,
        [
            {
                "waveform": wave,
                "tick_s": tick,
                "frequency_Hz": frequency,
                "thrust_mN": 1e3 * report.mean_thrust,
                "fin_amplitude_rad": report.fin_amplitude,
            }
            for (wave, tick, frequency), report in zip(cases, reports, strict=True)
        ],
    )


def draw() -> None:
    """Draw lines for the fine tick, points for that of the robot."""
    styles = (("-", "s", BLACK), ((0, (5, 2)), "o", BLUE), ((0, (1, 1)), "^", ORANGE))
    with drawing.open_figure(FOLDER / f"{NAME}.svg", (6.0, 3.8)) as figure:
        axes = figure.subplots()
        for wave, (line, marker, colour) in zip(WAVES, styles, strict=True):
            for tick in TICKS:
                rows = read(NAME, waveform=wave, tick_s=tick)
                fine = tick == FINE_TICK
                axes.plot(
                    column(rows, "frequency_Hz"),
                    column(rows, "thrust_mN"),
                    ls=line if fine else "",
                    marker="" if fine else marker,
                    mfc="white",
                    color=colour,
                    label=f"{wave}, {1e3 * tick:g} ms tick",
                )
        axes.set_xlabel("frequency (Hz)")
        axes.set_ylabel("mean thrust (mN)")
        axes.set_xlim(0.0, 4.1)
        axes.set_ylim(bottom=0.0)
        axes.legend()
