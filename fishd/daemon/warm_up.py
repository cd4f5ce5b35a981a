"""Mock ticks just before a real tick, which warm up the processor's caches.

While the loop sleeps, other programs use the caches, and a tick with cold caches takes several
times as long (docs/reference/performance.md). A mock tick runs the same code on a separate loop.
"""

from collections.abc import Callable

from msgspec.structs import replace

from fishd.assembly import build_loop, simulated_fish
from fishd.config import Config, Start
from fishd.core.clock import VirtualClock, virtual_slots
from fishd.daemon.gateway.gateways import Telemetry
from fishd.daemon.gateway.link import pair

MIN_TICK_S = 0.01
"""Shortest tick with mock ticks [s]; faster loops keep their caches warm by themselves."""
_INITIAL_TICKS, _TICKS_BEFORE_EACH = 20, 2
"""Number of mock ticks at the start, and before each real tick."""


def mock_ticks(config: Config) -> Callable[[], None] | None:
    """Return a function that runs mock ticks on a separate simulated fish; None if useless."""
    if config.tick < MIN_TICK_S or not config.realtime.warm_up:
        return None
    ours, theirs = pair()

    def publish(message: bytes) -> None:  # through the kernel like telemetry, without a receiver
        ours.send(message)
        theirs.recv(len(message))

    clock = VirtualClock()
    fish = simulated_fish(config)
    loop = build_loop(replace(config, start=Start()), fish.robot(), clock, Telemetry(publish))
    slots = virtual_slots(clock, config.tick)

    def warm_up(ticks: int = _TICKS_BEFORE_EACH) -> None:
        for _ in range(ticks):
            loop.tick(next(slots))

    warm_up(_INITIAL_TICKS)
    return warm_up
