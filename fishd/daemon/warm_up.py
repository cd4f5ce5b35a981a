"""Mock ticks just before a real one warm up the processor's caches for it.

While the loop sleeps, others take these caches, and a tick that finds them cold takes several times
as long (docs/reference/performance.md). A mock tick runs the same code on a loop of its own.
"""

from collections.abc import Callable

from msgspec.structs import replace

from fishd.assembly import build_loop, simulated_fish
from fishd.config import Config, Start
from fishd.core.clock import VirtualClock, virtual_slots
from fishd.daemon.gateway.gateways import Telemetry
from fishd.daemon.gateway.link import pair

SHORTEST_TICK = 0.01
"""Faster loops keep their caches warm by themselves [s]."""
_AT_FIRST, _AT_ONCE = 20, 2
"""Mock ticks at the start, and before each real one."""


def mock_ticks(config: Config) -> Callable[[], None] | None:
    """A function that runs mock ticks on a simulated fish of its own; None where useless."""
    if config.tick < SHORTEST_TICK or not config.realtime.warm_up:
        return None
    ours, theirs = pair()

    def publish(message: bytes) -> None:  # through the kernel, as telemetry goes, but to nobody
        ours.send(message)
        theirs.recv(len(message))

    clock = VirtualClock()
    fish = simulated_fish(config)
    loop = build_loop(replace(config, start=Start()), fish.robot(), clock, Telemetry(publish))
    slots = virtual_slots(clock, config.tick)

    def warm_up(ticks: int = _AT_ONCE) -> None:
        for _ in range(ticks):
            loop.tick(next(slots))

    warm_up(_AT_FIRST)
    return warm_up
