"""Slow motion: ticks of a fish that takes longer to compute than to swim.

Its time, which is that of the loop and of the controllers, moves by one period with each tick, and
between two ticks several periods of real time pass. So no tick is late, none is skipped, and on a
machine that is too slow the motion is only slower.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Self

BREATH = 0.002
"""Requests and telemetry have so long between two ticks, at least [s]."""
SPAN = 100
"""The pace is that of so many ticks."""
TOO_SLOW = 1.1
"""A status says so once a second of the fish takes so many times what it should."""


class SlowMotion:
    """Paces ticks as a `Ticker` does, but never skips one."""

    def __init__(self, period: float, factor: float) -> None:
        """period: of the loop, in the fish's time [s]; factor: seconds for each of its seconds"""
        self._period, self._factor = period, factor
        self.stopping = asyncio.Event()
        """Ends the wait for a tick."""
        self.meanwhile: Callable[[], object] = lambda: None
        """Called once a period of real time while a tick is waited for."""
        self._due = time.monotonic()
        self._latest: deque[float] = deque(maxlen=SPAN)

    def close(self) -> None:
        """Nothing is to be given back."""

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> None:
        """Wait until the next tick may begin, or fishd is to end."""
        begin = max(self._due, time.monotonic() + BREATH)
        while (left := begin - time.monotonic()) > 0.0 and not self.stopping.is_set():
            with suppress(TimeoutError):
                async with asyncio.timeout(min(left, self._period)):
                    await self.stopping.wait()
            if left > self._period:
                self.meanwhile()
        # A delay of up to a period is made up for; a longer one is forgotten, without a rush.
        self._begin(max(self._due, time.monotonic() - self._period))

    def hurry(self) -> None:
        """Let the next tick begin at once: somebody else sets the pace."""
        self._begin(time.monotonic())

    def _begin(self, due: float) -> None:
        self._latest.append(time.monotonic())
        self._due = due + self._factor * self._period

    @property
    def pace(self) -> float:
        """How many seconds a second of the fish has taken lately."""
        if len(self._latest) < 2:
            return self._factor
        return (self._latest[-1] - self._latest[0]) / ((len(self._latest) - 1) * self._period)

    def degraded(self) -> str:
        """What a status says of it, in one line."""
        line = f"slow motion: a second of the fish takes {self.pace:.3g} s"
        if self.pace > TOO_SLOW * self._factor:
            line += f", since this machine is too slow for swimmer.slow_motion: {self._factor:g}"
        return line
