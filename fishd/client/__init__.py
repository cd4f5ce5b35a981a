"""Python API to a running daemon; `fishctl` uses it, too.

    with Fish() as fish:
        fish.set_controller("swing", C=0.6)
        for tick in fish.ticks():
            print(tick.t, tick.thrust)

An experiment leases the fish, `with fish.lease("my experiment"):`, and fishd brings it to rest if
the program dies. `AsyncFish` is the same for asyncio. A socket belongs to one thread, and so does a
`Fish`. An `Agent` chooses the instruction angle itself, tick by tick.
"""

from typing import TYPE_CHECKING, Any

from fishd.core.errors import FishError, LeaseLost, NoDaemon, Refused

if TYPE_CHECKING:
    from fishd.client.agent import Agent
    from fishd.client.asynchronous import AsyncFish
    from fishd.client.synchronous import Fish

__all__ = ["Agent", "AsyncFish", "Fish", "FishError", "LeaseLost", "NoDaemon", "Refused"]


def __getattr__(name: str) -> Any:
    """Import a client at its first use: zmq and asyncio take most of the time of a command."""
    if name == "Agent":
        from fishd.client.agent import Agent

        return Agent
    if name == "AsyncFish":
        from fishd.client.asynchronous import AsyncFish

        return AsyncFish
    if name == "Fish":
        from fishd.client.synchronous import Fish

        return Fish
    raise AttributeError(f"module 'fishd.client' has no attribute '{name}'")
