"""Time axis of a recording, from fishd's monotonic clock, and the steps of its unix clock."""

import math
from typing import NamedTuple

from msgspec import Struct

MIN_STEP_S = 0.1
"""Smallest change of the unix clock that counts as a step; the daemons of NTP make smaller ones
gradually [s]."""
MAX_SLEW = 1e-3
"""Rate of a gradual change that is never a step [s/s]."""
MAX_STEPS = 100
"""Maximum number of steps in a list."""
MAX_TRUSTED_S = 10.0
"""Longest time between two ticks of one fishd that needs no confirmation [s]."""
AGREEMENT_S = 1.0
"""Largest difference between two clocks that confirm each other: a recorder reads its messages
every 0.2 s [s]."""


class ClockStep(Struct, frozen=True):
    """A step of the unix clock of fishd's machine."""

    at: float
    """Time of the first tick after it, since the first tick of the recording [s]."""
    by: float
    """Amount by which the clock was set forward; negative where it was set back [s]."""

    def __str__(self) -> str:
        return f"the clock was set by {self.by:+.1f} s at {self.at:.1f} s".replace("-", "−")


class _Moment(NamedTuple):
    """Times of a message [s]."""

    position: float
    time: float
    """On the monotonic clock of fishd."""
    t: float
    """On the unix clock."""
    arrival: float | None
    """On the monotonic clock of this machine."""
    seq: int
    """Number of a tick; 0 for another message."""


class Axis:
    """Places messages on an axis that no step of the unix clock moves.

    The time between two messages is that on fishd's monotonic clock. Another fishd may have another
    monotonic clock, that of another boot or a virtual one: a time between two messages that may be
    of different fishds, or that is unusually long, counts only if the arrival of the messages or
    the unix clock confirms it. Otherwise their arrival counts, and without it the unix clock.
    """

    def __init__(self) -> None:
        self._latest: _Moment | None = None
        """The latest tick, or the first message before it."""

    def place(
        self, t: float, time: float, seq: int | None = None, arrival: float | None = None
    ) -> float:
        """Return the time of a message since the first message [s].

        t, time: its time on the unix clock, and on fishd's monotonic clock [s]; 0 if unknown
        seq: number of a tick; None for another message
        arrival: when it arrived, on the monotonic clock of this machine [s]; None if unknown
        """
        position, latest = 0.0, self._latest
        if latest is not None:
            position = latest.position + _choose_interval(
                latest,
                time - latest.time if time or (seq and latest.time) else None,
                t - latest.t,
                None if arrival is None or latest.arrival is None else arrival - latest.arrival,
                seq,
            )
        if seq is not None or latest is None:
            self._latest = _Moment(position, time, t, arrival, seq or 0)
        return position


def _choose_interval(
    latest: _Moment,
    elapsed: float | None,
    by_wall: float,
    by_arrival: float | None,
    seq: int | None,
) -> float:
    """Return the time between a message and the latest tick before it [s].

    elapsed: on the monotonic clock; None where a message has no such time
    seq: number of a tick; None for another message
    """
    witnesses = [by_wall] if by_arrival is None else [by_arrival, by_wall]
    if elapsed is not None:
        lowest = highest = 0.0
        if seq is None:
            lowest, highest = -AGREEMENT_S, AGREEMENT_S
        elif seq > latest.seq:
            highest = math.inf if by_arrival is None else MAX_TRUSTED_S
        is_confirmed = any(abs(elapsed - time) <= AGREEMENT_S for time in witnesses)
        if lowest <= elapsed and (elapsed <= highest or is_confirmed):
            return elapsed
    return next((time for time in witnesses if time >= 0.0), 0.0)


class ClockSteps:
    """Finder of steps of the unix clock, from the ticks of a recording."""

    def __init__(self) -> None:
        self.steps: list[ClockStep] = []
        self._clock: tuple[float, float] | None = None
        """Position of the latest tick, and its time on the monotonic clock [s]."""
        self._offset = 0.0
        """Unix time minus monotonic time, before a step [s]."""
        self._suspected: tuple[float, float] | None = None
        """Position and offset of a tick that may be the first one after a step [s]."""

    def add(self, position: float, t: float, time: float) -> None:
        """Add a tick; the next one must confirm a step: a tick may be delayed between two clocks.

        position: on the axis of the recording [s]
        t, time: unix and monotonic time at one moment of the tick [s]
        """
        offset, clock = t - time, self._clock
        self._clock = position, time
        if clock is None or abs((position - clock[0]) - (time - clock[1])) > 0.01:
            self._offset, self._suspected = offset, None  # the monotonic clock of another fishd
            return
        if abs(offset - self._offset) <= MIN_STEP_S + MAX_SLEW * (position - clock[0]):
            self._offset, self._suspected = offset, None
            return
        suspected, self._suspected = self._suspected, (position, offset)
        if suspected and abs(offset - suspected[1]) <= MIN_STEP_S:
            if len(self.steps) < MAX_STEPS:
                by = suspected[1] - self._offset
                self.steps.append(ClockStep(round(suspected[0], 3), round(by, 3)))
            self._offset, self._suspected = offset, None
