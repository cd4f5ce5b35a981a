"""Mock ticks just before a real one, so that the real one finds warm caches.

While the loop sleeps, others take the processor's caches, and a tick that finds them cold takes
several times as long (docs/performance.md). A mock tick runs the same code on a loop of its own.
"""

from collections.abc import Callable

from msgspec.structs import replace

from fishd.build import build_loop
from fishd.clock import VirtualClock, VirtualTicker
from fishd.config import Config, Start
from fishd.hardware.simulated import SimulatedFish
from fishd.telemetry import unheard

SHORTEST_TICK = 0.01
"""Faster loops keep their caches warm by themselves [s]."""
_WARM_UP = 20
_AT_ONCE = 2


def rehearsal(config: Config) -> Callable[[], None] | None:
    """A function that runs mock ticks on a simulated fish that nobody sees; None where useless."""
    if config.tick < SHORTEST_TICK or not config.realtime.rehearse:
        return None
    clock = VirtualClock()
    fish = SimulatedFish(config.plant, config.simulation, config.tick)
    loop = build_loop(replace(config, start=Start()), fish.robot(), clock, unheard())
    slots = iter(VirtualTicker(clock, config.tick))

    def rehearse(ticks: int = _AT_ONCE) -> None:
        for _ in range(ticks):
            loop.tick(next(slots))

    rehearse(_WARM_UP)
    return rehearse
