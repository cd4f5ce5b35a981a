"""Tail-beat frequency and thrust over whole beats, from the reversals of the instruction angle."""

import math
from collections import deque


class TailBeat:
    """Sums half beats, from one reversal to the next.

    A mean over whole beats carries none of the ripple that thrust has within a beat.
    """

    _REST = 1.0
    """Time constant of the mean force while the tail does not beat [s]."""
    _LONGEST = 2.0
    """A tail that stays longer at one side does not beat [s]."""

    def __init__(self, span: float = 4.0) -> None:
        """`span` bounds the time that the means look back [s]; they cover at least one beat."""
        self._span = span
        self.thrust = 0.0
        """Mean force over the same beats; over the last second or so when not beating [N]."""
        self.rest()

    def rest(self) -> None:
        """Forget all beats, but not the mean force."""
        self._halves: deque[tuple[float, float]] = deque()  # (duration [s], impulse [N s])
        self._side = 0.0
        self.side_time = 0.0
        """How long the angle has been on its side of neutral, signed as it is; up to 2 s [s]."""
        self._open: tuple[float, float] | None = None
        self._longest = 0.0
        self.frequency = 0.0
        """Beats per second over the latest whole beats; 0 when not beating [Hz]."""

    def update(self, angle: float, force: float, duration: float) -> None:
        """Add a window.

        angle: instruction angle applied during the window [rad]
        force: mean longitudinal force of the window [N]
        duration: its length [s]
        """
        side = math.copysign(1.0, angle) if angle else self._side
        if side != self._side:
            if self._side:
                self._reverse()
            self._side = side
        before = abs(self.side_time) if self.side_time * angle > 0.0 else 0.0
        elapsed = min(before + duration, self._LONGEST)
        self.side_time = math.copysign(elapsed, angle) if angle else 0.0
        if self._open is not None:
            elapsed, impulse = self._open
            self._open = (elapsed + duration, impulse + force * duration)
            # Overdue by as much as the longest half beat took: the tail has stopped.
            if self.frequency and elapsed > 2.0 * self._longest:
                self._halves.clear()
                self._open = None
                self.frequency = 0.0
        if not self.frequency:
            self.thrust -= math.expm1(-duration / self._REST) * (force - self.thrust)

    def _reverse(self) -> None:
        """Close the open half beat; one that began before the first reversal is no whole one."""
        if self._open is not None:
            self._halves.append(self._open)
        self._open = (0.0, 0.0)
        while len(self._halves) > 3 and sum(half[0] for half in self._halves) > self._span:
            self._halves.popleft()
        if len(self._halves) < 2:
            return
        whole = list(self._halves)[len(self._halves) % 2 :]
        self._longest = max(half[0] for half in whole)
        time = sum(half[0] for half in whole)
        self.frequency = 0.5 * len(whole) / time
        self.thrust = sum(half[1] for half in whole) / time
