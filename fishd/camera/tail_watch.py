"""Latest fin angle for people: with its maximum per beat, and its lag behind the instruction."""

import math
from collections import deque

import numpy as np

from fishd.camera.tail.beats import Beat, find_maxima
from fishd.core.tail_reading import TailReading

SPAN_S = 5.0
"""Time over which maximum and lag are taken [s]."""
_POINTS_PER_BEAT = 64
"""Points per beat of the sums for the lag."""
_MIN_COMMAND_RAD = 1e-3
"""Smallest amplitude of the instruction angle that the tail is said to follow [rad]."""


class TailWatch:
    """Fin angles and instruction angles of the latest seconds, on one clock.

    The two may be added in other threads than the one that reads the results.
    """

    def __init__(self) -> None:
        self.latest: TailReading | None = None
        self._angles: deque[tuple[float, float | None]] = deque(maxlen=4096)
        self._commands: deque[tuple[float, float]] = deque(maxlen=4096)

    def add(self, reading: TailReading) -> None:
        """Add a fin angle."""
        if self._angles and reading.time < self._angles[-1][0]:  # of another camera or clock
            self._angles.clear()
        self.latest = reading
        self._angles.append((reading.time, reading.alpha))
        while self._angles[0][0] < reading.time - SPAN_S:
            self._angles.popleft()

    def add_command(self, time: float, phi_c: float) -> None:
        """Add the instruction angle φ_c [rad] of a tick [s]."""
        if self._commands and time < self._commands[-1][0]:
            self._commands.clear()
        self._commands.append((time, phi_c))
        while self._commands[0][0] < time - 2.0 * SPAN_S:
            self._commands.popleft()

    @property
    def alpha_max(self) -> float | None:
        """Mean of the largest fin angles of the latest beats [rad]; None while nothing swings."""
        beats = self._beats()
        return sum(beat.alpha_max for beat in beats) / len(beats) if beats else None

    def _beats(self) -> list[Beat]:
        angles = list(self._angles)
        return find_maxima(*zip(*angles, strict=True)) if angles else []

    @property
    def lag(self) -> float | None:
        """Delay of the fin angle after the instruction angle, less than a period [s].

        It is that of their fundamentals at the frequency of the beat. None where it is unknown.
        """
        beats, angles = self._beats(), np.array(list(self._angles), np.float64)
        commands = np.array(list(self._commands))
        if len(beats) < 2 or not len(commands):
            return None
        period = float(np.median(np.diff([beat.time for beat in beats])))
        time, alpha = angles[np.isfinite(angles[:, 1])].T
        count = math.floor((time[-1] - max(time[0], commands[0, 0])) / period)
        at = time[-1] - period * np.arange(count * _POINTS_PER_BEAT) / _POINTS_PER_BEAT
        if count < 1:
            return None
        active = np.searchsorted(commands[:, 0], at, side="right") - 1
        wave = np.exp(-2j * math.pi / period * at)
        command = wave @ commands[active, 1]
        if abs(command) < _MIN_COMMAND_RAD * len(at):
            return None
        turn = np.angle(command / (wave @ np.interp(at, time, alpha)))
        return float(turn % math.tau / math.tau * period)

    def describe(self) -> str:
        """Return all of it in a line."""
        latest = self.latest
        if latest is None:
            return "no fin angle"
        if latest.alpha is None:
            return f"fin angle unknown: {latest.reason}"
        error = "" if latest.uncertainty is None else f" ± {latest.uncertainty:.3f}"
        parts = [f"fin angle {latest.alpha:+.3f}{error} rad"]
        if (alpha_max := self.alpha_max) is not None:
            parts.append(f"maximum {alpha_max:.3f} rad")
        if (lag := self.lag) is not None:
            parts.append(f"{lag * 1e3:.0f} ms after φ_c")
        return ", ".join(filter(None, [*parts, latest.reason]))
