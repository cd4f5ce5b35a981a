"""Tail-beat frequency and thrust over whole beats, from the reversals of the instruction angle."""

import math


class TailBeat:
    """Sums over half beats, each from one reversal to the next.

    A mean over whole beats is free of the ripple of the thrust within a beat.
    """

    _REST_TIME_S = 1.0
    """Time constant of the mean force while the tail does not beat [s]."""
    _MAX_SIDE_TIME_S = 2.0
    """Largest `side_time`; a tail that stays longer on one side does not beat [s]."""

    def __init__(self, span: float = 4.0) -> None:
        """span: time that the means cover at most [s]; they cover at least one beat"""
        self._span = span
        self.thrust = 0.0
        """Mean force over the beats of `frequency`; over about a second when not beating [N]."""
        self.rest()

    def rest(self) -> None:
        """Forget all beats, but not the mean force."""
        self._halves: list[tuple[float, float]] = []  # (duration [s], impulse [N s])
        self._side = 0.0
        self.side_time = 0.0
        """Time since the angle came to its side of neutral, up to 2 s, with its sign [s]."""
        self._open: tuple[float, float] | None = None
        self._longest = 0.0
        self.frequency = 0.0
        """Frequency of the latest whole beats; 0 when not beating [Hz]."""

    def update(self, angle: float, force: float, duration: float) -> None:
        """Add a window.

        angle: instruction angle applied during the window [rad]
        force: mean longitudinal force of the window [N]
        duration: its length [s]
        """
        side = self._side
        if angle:
            side = 1.0 if angle > 0.0 else -1.0
            elapsed = duration
            if side * self.side_time > 0.0:
                elapsed += side * self.side_time
            self.side_time = side * (
                elapsed if elapsed < self._MAX_SIDE_TIME_S else self._MAX_SIDE_TIME_S
            )
        else:
            self.side_time = 0.0
        if side != self._side:
            if self._side:
                self._reverse()
            self._side = side
        if self._open is not None:
            elapsed, impulse = self._open
            self._open = (elapsed + duration, impulse + force * duration)
            # Twice as long as the longest half beat: the tail has stopped.
            if self.frequency and elapsed > 2.0 * self._longest:
                self._halves.clear()
                self._open = None
                self.frequency = 0.0
        if not self.frequency:
            self.thrust -= math.expm1(-duration / self._REST_TIME_S) * (force - self.thrust)

    def _reverse(self) -> None:
        """Close the open half beat, unless it began before the first reversal and is incomplete."""
        halves = self._halves
        if self._open is not None:
            halves.append(self._open)
        self._open = (0.0, 0.0)
        while len(halves) > 3 and _sums(halves)[0] > self._span:
            del halves[0]
        if len(halves) < 2:
            return
        whole = halves[len(halves) % 2 :]
        self._longest = max(whole)[0]
        time, impulse = _sums(whole)
        self.frequency = 0.5 * len(whole) / time
        self.thrust = impulse / time


def _sums(halves: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the sums of some half beats: durations [s] and impulses [N s]."""
    duration = impulse = 0.0
    for half_duration, half_impulse in halves:
        duration += half_duration
        impulse += half_impulse
    return duration, impulse
