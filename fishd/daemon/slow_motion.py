"""Slow motion: ticks of a simulated fish whose computation takes longer than its motion.

The fish's time, which is that of the loop and of the controllers, advances by one period in each
tick, while several periods of real time pass. So no tick is late or skipped, and on a machine that
is too slow the motion is only slower.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Self

MIN_PAUSE_S = 0.002
"""Shortest time for requests and telemetry between two ticks [s]."""
PACE_TICKS = 100
"""Number of ticks over which the pace is measured."""
MAX_PACE_RATIO = 1.1
"""Ratio of the pace to the configured factor above which the status reports it."""


class SlowMotion:
    """Pace of ticks like that of a `Ticker`, but without skipped ticks."""

    def __init__(self, period: float, factor: float) -> None:
        """Start the pace.

        period: period of the loop in the fish's time [s]
        factor: real time per time of the fish
        """
        self._period, self._factor = period, factor
        self.stopping = asyncio.Event()
        """Event that ends the wait for a tick."""
        self.while_waiting: Callable[[], object] = lambda: None
        """Function called once per period of real time during the wait for a tick."""
        self._due = time.monotonic()
        self._latest: deque[float] = deque(maxlen=PACE_TICKS)

    def close(self) -> None:
        """Do nothing: no resource has to be released."""

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> None:
        """Wait until the next tick may start, or fishd has to end."""
        start = max(self._due, time.monotonic() + MIN_PAUSE_S)
        while (remaining := start - time.monotonic()) > 0.0 and not self.stopping.is_set():
            with suppress(TimeoutError):
                async with asyncio.timeout(min(remaining, self._period)):
                    await self.stopping.wait()
            if remaining > self._period:
                self.while_waiting()
        # A delay of up to one period is made up for; the rest of a longer delay is dropped.
        self._start(max(self._due, time.monotonic() - self._period))

    def start_now(self) -> None:
        """Start the next tick at once, when an agent sets the pace."""
        self._start(time.monotonic())

    def _start(self, due: float) -> None:
        self._latest.append(time.monotonic())
        self._due = due + self._factor * self._period

    @property
    def pace(self) -> float:
        """Real time per time of the fish over the latest ticks."""
        if len(self._latest) < 2:
            return self._factor
        return (self._latest[-1] - self._latest[0]) / ((len(self._latest) - 1) * self._period)

    def limitations(self) -> str:
        """Return the line about slow motion for the status."""
        line = f"slow motion: a second of the fish takes {self.pace:.3g} s"
        if self.pace > MAX_PACE_RATIO * self._factor:
            line += f", since this machine is too slow for swimmer.slow_motion: {self._factor:g}"
        return line
