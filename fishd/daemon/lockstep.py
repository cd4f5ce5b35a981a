"""Lockstep: ticks of virtual time, which wait for the agent while `remote` is active."""

import asyncio
import os
from collections.abc import Callable
from typing import Self

from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.controllers.remote.controller import Remote
from fishd.core.clock import Slot, Ticker, VirtualClock, virtual_slots
from fishd.daemon.slow_motion import SlowMotion

POLL = 0.02
"""How soon a wait notices that another controller is active, or that fishd ends [s]."""


class Lockstep:
    """Yields slots as a `Ticker` does, and turns the loop in them.

    While `remote` is active, a tick follows as soon as the agent has answered. Otherwise ticks come
    at the pace of real time, or in slow motion.
    """

    def __init__(
        self, loop: ControlLoop, clock: VirtualClock, period: float, pace: SlowMotion | None = None
    ) -> None:
        """Must be made inside a running asyncio loop. pace: that of real time by default"""
        self._loop = loop
        self._slots = virtual_slots(clock, period)
        self._pace = pace or Ticker(period)
        self._events = asyncio.get_running_loop()
        self._news = asyncio.Event()

    def close(self) -> None:
        """Stop ticking; may be called twice."""
        self._pace.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Slot:
        """The next slot, once it is due."""
        if self._agent():
            await asyncio.sleep(0)  # requests have their turn, however quick the agent is
            if isinstance(self._pace, SlowMotion):
                self._pace.hurry()
        else:
            await anext(self._pace)
        return next(self._slots)

    async def tick(self, slot: Slot, poll: Callable[[], None]) -> None:
        """One turn of the loop, which waits for the agent as long as `remote` is active.

        An agent that sends what is no answer ends the wait, with a fault.
        poll: called again and again meanwhile; may select another controller
        """
        turn = self._loop.observe(slot)
        while (agent := self._agent()) and not agent.ready(turn.observation):
            await self._wait_for(agent)
            poll()
        self._loop.act(turn)

    def _agent(self) -> Remote | None:
        """The active controller, where it waits for an agent."""
        controller = self._loop.active.controller
        running = self._loop.supervisor.mode is Mode.RUNNING
        return controller if running and isinstance(controller, Remote) else None

    async def _wait_for(self, agent: Remote) -> None:
        # A copy: a change of controller closes the socket while this still waits for it.
        descriptor = os.dup(agent.fileno())
        self._news.clear()
        self._events.add_reader(descriptor, self._news.set)
        try:
            async with asyncio.timeout(POLL):
                await self._news.wait()
        except TimeoutError:
            pass
        finally:
            self._events.remove_reader(descriptor)
            os.close(descriptor)
