"""Lockstep: ticks in virtual time, which wait for the agent while `remote` is active."""

import asyncio
import os
from collections.abc import Callable
from typing import Self

from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.controllers.remote.controller import Remote
from fishd.core.clock import Slot, Ticker, VirtualClock, virtual_slots
from fishd.daemon.slow_motion import SlowMotion

POLL_PERIOD_S = 0.02
"""Time within which a wait notices that another controller is active, or that fishd ends [s]."""


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
        turn = self._loop.observe(slot)
        while (agent := self._agent()) and not agent.ready(turn.observation):
            await self._wait_for(agent)
            poll()
        self._loop.act(turn)

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
