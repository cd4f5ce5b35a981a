"""Means of the true motion and forces of a plant over whole beats."""

import math
import sys
from collections.abc import Sequence
from typing import NamedTuple

from fishd.core.beats import Reversals
from fishd.virtual.plant.base import TrueWindow


class Beats:
    """Sums of the true quantities of a plant over whole beats, between upward reversals.

    For a run without a whole beat, the sums cover all its time.
    """

    def __init__(self) -> None:
        self._whole_beats = _Sums()
        self._open_beat = _Sums()
        self._before_beats = _Sums()
        """Sums over the time before the first beat."""
        self.reversals = 0
        self._began = False
        self._reversals = Reversals()
        self._beats: list[tuple[float, float]] = []  # impulse N s, duration s

    @property
    def count(self) -> int:
        """Number of whole beats."""
        return len(self._beats)

    def add(self, angle: float, window: TrueWindow) -> None:
        """Add a window; angle: the instruction angle during it [rad]."""
        if reversal := self._reversals.add(angle):
            self._open_beat.close_half()
            self.reversals += 1
            if reversal > 0:
                if self._began:
                    self._whole_beats += self._open_beat
                    self._beats.append((self._open_beat.impulse, self._open_beat.duration))
                else:
                    self._before_beats = self._open_beat
                self._began = True
                self._open_beat = _Sums()
        self._open_beat.add(angle, window)

    def means(self) -> "BeatMeans":
        """Return the means over the whole beats."""
        sums = self._whole_beats
        frequency = 0.5 * sums.halves / sums.duration if sums.halves else 0.0
        if not sums.halves:
            self._open_beat.close_half()
            sums = self._before_beats
            sums += self._open_beat
        mean = sums.angle / sums.duration
        rms = math.sqrt(sums.angle_squared / sums.duration)
        return BeatMeans(
            thrust=sums.impulse / sums.duration,
            thrust_deviation=_thrust_standard_error(self._beats),
            frequency=frequency,
            fin_amplitude=sums.peaks / sums.halves,
            mean_angle=mean,
            squareness=mean / rms if rms else 0.0,
            power=None if math.isnan(sums.energy) else sums.energy / sums.duration,
            half_beats=(sums.shortest, sums.longest) if frequency else (0, 0),
        )


class BeatMeans(NamedTuple):
    """Means over beats."""

    thrust: float  # N
    frequency: float  # Hz
    fin_amplitude: float  # rad
    mean_angle: float  # of |φ_c|, rad
    squareness: float  # mean |φ_c| over rms φ_c
    power: float | None  # electrical, of the servo, W; None for a fish without a motor
    half_beats: tuple[int, int]  # shortest and longest, ticks
    thrust_deviation: float  # standard error of the thrust, from the spread of beats, N; or NaN


def _thrust_standard_error(beats: Sequence[tuple[float, float]]) -> float:
    """Return the standard error of total impulse over total duration; NaN for less than two beats.

    Cochran, Sampling Techniques, 3rd edition, equation 6.9.
    """
    n = len(beats)
    if n < 2:
        return math.nan
    duration = sum(length for _, length in beats)
    mean = sum(impulse for impulse, _ in beats) / duration
    squares = sum((impulse - mean * length) ** 2 for impulse, length in beats)
    return math.sqrt(squares * n / (n - 1)) / duration


class _Sums:
    def __init__(self) -> None:
        self.duration = self.impulse = self.peaks = self.angle = self.angle_squared = 0.0
        self.energy = 0.0
        self.halves = 0
        self.shortest, self.longest = sys.maxsize, 0
        self._peak = 0.0
        self._ticks = 0

    def add(self, angle: float, window: TrueWindow) -> None:
        duration = window.duration
        self.duration += duration
        self.impulse += window.thrust * duration
        self.energy += window.power * duration
        self.angle += (angle if angle > 0.0 else -angle) * duration
        self.angle_squared += angle**2 * duration
        if window.fin_peak > self._peak:
            self._peak = window.fin_peak
        self._ticks += 1

    def close_half(self) -> None:
        self.halves += 1
        self.peaks += self._peak
        self.shortest = min(self.shortest, self._ticks)
        self.longest = max(self.longest, self._ticks)
        self._peak = 0.0
        self._ticks = 0

    def __iadd__(self, other: "_Sums") -> "_Sums":
        self.duration += other.duration
        self.impulse += other.impulse
        self.energy += other.energy
        self.peaks += other.peaks
        self.angle += other.angle
        self.angle_squared += other.angle_squared
        self.halves += other.halves
        self.shortest = min(self.shortest, other.shortest)
        self.longest = max(self.longest, other.longest)
        return self
