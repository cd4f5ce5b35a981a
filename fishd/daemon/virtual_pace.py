"""Pace of ticks in virtual time: in slow motion, or in lockstep with the agent of `remote`."""

import asyncio
import os
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Self

from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.controllers.remote.controller import Remote
from fishd.core.clock import Slot, Ticker, VirtualClock, virtual_slots

MIN_PAUSE_S = 0.002
"""Shortest time for requests and telemetry between two ticks [s]."""
PACE_TICKS = 100
"""Number of ticks over which the pace is measured."""
MAX_PACE_RATIO = 1.1
"""Ratio of the pace to the configured factor above which the status reports it."""
POLL_PERIOD_S = 0.02
"""Time within which a wait notices that another controller is active, or that fishd ends [s]."""


class SlowMotion:
    """Pace of ticks like that of a `Ticker`, but without skipped ticks.

    It is for a fish whose computation takes longer than its motion. The fish's time, which is that
    of the loop and of the controllers, advances by one period in each tick, while several periods
    of real time pass. So no tick is late, and on a machine that is too slow the motion is only
    slower.
    """

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
            line += f", since this machine is too slow for the configured {self._factor:g} s"
        return line


class Lockstep:
    """Source of slots like a `Ticker`, which also runs the loop in them.

    While `remote` is active, the next tick starts as soon as the agent has answered. Otherwise
    ticks come at the pace of real time, or in slow motion.
    """

    def __init__(
        self, loop: ControlLoop, clock: VirtualClock, period: float, pace: SlowMotion | None = None
    ) -> None:
        """Start the ticks; must be called in a running asyncio loop.

        pace: source of the ticks while no agent is waited for; real time by default
        """
        self._loop = loop
        self._slots = virtual_slots(clock, period)
        self._pace = pace or Ticker(period)
        self._events = asyncio.get_running_loop()
        self._answered = asyncio.Event()

    def close(self) -> None:
        """Stop ticking; may be called twice."""
        self._pace.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Slot:
        """Return the next slot, once it is due."""
        if self._agent():
            await asyncio.sleep(0)  # lets requests run, however quick the agent is
            if isinstance(self._pace, SlowMotion):
                self._pace.start_now()
        else:
            await anext(self._pace)
        return next(self._slots)

    async def tick(self, slot: Slot, poll: Callable[[], None]) -> None:
        """Run one tick of the loop, which waits for the agent as long as `remote` is active.

        An invalid answer of the agent ends the wait, with a fault.
        poll: function called repeatedly during the wait; may select another controller
        """
        inputs = self._loop.observe(slot)
        while (agent := self._agent()) and not agent.ready(inputs.observation):
            await self._wait_for(agent)
            poll()
        self._loop.act(inputs)

    def _agent(self) -> Remote | None:
        """Return the active controller if it waits for an agent, else None."""
        controller = self._loop.active.controller
        running = self._loop.supervisor.mode is Mode.RUNNING
        return controller if running and isinstance(controller, Remote) else None

    async def _wait_for(self, agent: Remote) -> None:
        # A duplicate, because a change of controller closes the socket during the wait.
        descriptor = os.dup(agent.fileno())
        self._answered.clear()
        self._events.add_reader(descriptor, self._answered.set)
        try:
            async with asyncio.timeout(POLL_PERIOD_S):
                await self._answered.wait()
        except TimeoutError:
            pass
        finally:
            self._events.remove_reader(descriptor)
            os.close(descriptor)
