"""Films of tails that are learned and then measured, and the errors of their fin angles."""

from functools import cache
from typing import NamedTuple

import numpy as np

from fishd.camera.tail.beats import find_maxima
from fishd.camera.tail.learned import Learned
from fishd.camera.tail.learner import Learner
from fishd.camera.tail.lens import Lens
from fishd.camera.tail.meter import TailMeter
from fishd.core.tail_reading import TailReading
from rigs.filmed_tail import Film, FilmedTail

AMPLITUDE = 0.42
"""Amplitude of the default motion of a film [rad]."""
WEB = "web camera, waves"
BENDING = "bending fin"
BESIDE = "lens, tilt, fin beside the middle"
CASES = {
    "plain": Film(),
    "1280 × 720, light tail, yaw": Film(
        width=1280, height=720, tiles=25, flicker=0.08, read_out=0.01, water=60, tail=170, yaw=0.2,
        lost=0.05, length=0.42, root=(0.25, -0.04),
    ),
    "faint": Film(water=120, tail=80, noise=12),
    "15 pictures a second": Film(rate=15.0),
    WEB: Film(
        waves=0.7, caustics=12, exposure=0.02, read_out=0.02, noise=6
    ),
    BESIDE: Film(lens=-0.12, tilt=0.08),
    "lens, tilt": Film(lens=-0.12, tilt=0.08, root=(0.08, 0.0)),
    "tilt of 0.2 rad": Film(tilt=-0.2, root=(0.08, 0.0)),
    "pixels 5 % too high": Film(aspect=1.05),
    BENDING: Film(bend=0.03),
}  # fmt: skip
ASKED: dict[str, tuple[float | None, float | None]] = dict(
    zip(
        CASES,
        [
            (2, 1),
            (2, 1),
            (5, 2),
            (None, 2),
            (20, 3),
            *2 * [(None, 2.5)],
            *2 * [(None, None)],
            (6, None),
        ],
        strict=True,
    )
)
"""Largest rms error of the fin angle after its zero [mrad] and error of its maximum [%]."""

BENT = [case for case, film in CASES.items() if film.lens or film.tilt or film.aspect != 1.0]
"""Films whose view needs a calibration."""
ASKED_CALIBRATED = 1.0
"""Largest error of the maximum with it [%]."""


class Errors(NamedTuple):
    """Errors of readings of a film."""

    zero: float
    """Mean error [rad]."""
    rms: float
    """Root mean square without the mean [rad]."""
    worst: float
    """Largest error [rad]."""
    alpha_max: float
    """Relative error of the mean maximum of whole beats of the default motion."""
    covered: float
    """Fraction of the readings whose error after the zero is within `uncertainty`."""
    known: float
    """Fraction of the pictures whose fin angle is known."""


@cache
def learn(film: Film, lens: Lens | None = None) -> Learned:
    """Return what the first five seconds of a film show."""
    learner = Learner(lens)
    for shot in FilmedTail(film).shots(0.0, 5.0):
        learner.add(*shot)
    return learner.finish()


def measure(film: Film, learned: Learned, begin: float, end: float) -> list[TailReading]:
    """Return the readings of a part of a film."""
    meter = TailMeter(learned)
    shots = FilmedTail(film).shots(begin, end)
    return [meter.read(shot.time, shot.picture, film.read_out) for shot in shots]


def find_errors(film: Film, readings: list[TailReading]) -> Errors:
    """Return the errors of the fin angles that are known."""
    alpha = [reading.alpha for reading in readings]
    times = np.array([reading.time for reading in readings])
    known = np.array([angle is not None for angle in alpha])
    if not known.any():
        return Errors(0.0, 0.0, 0.0, np.nan, np.nan, 0.0)
    truth = film.motion(times[known])
    error = np.array([angle for angle in alpha if angle is not None]) - truth
    limits = np.array([reading.uncertainty or 0.0 for reading in readings])[known]
    rest = error - error.mean()
    beats = find_maxima(times.tolist(), alpha)
    top = np.mean([beat.alpha_max for beat in beats]) if beats else np.nan
    return Errors(
        zero=float(error.mean()),
        rms=float(rest.std()),
        worst=float(np.abs(error).max()),
        alpha_max=float(top / AMPLITUDE - 1.0),
        covered=float(np.mean(np.abs(rest) <= limits)),
        known=float(known.mean()),
    )
