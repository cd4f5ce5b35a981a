"""The Python API to a running daemon: what fishctl itself is made of.

    with Fish() as fish:
        fish.set_controller("swing", C=0.6)
        for tick in fish.ticks():
            print(tick.t, tick.thrust)

`AsyncFish` offers the same to asyncio. A socket belongs to one thread, and so does a `Fish`.
"""

from typing import TYPE_CHECKING, Any

from fishd.client.synchronous import Fish
from fishd.errors import FishError, NoDaemon, Refused

if TYPE_CHECKING:
    from fishd.client.asynchronous import AsyncFish

__all__ = ["AsyncFish", "Fish", "FishError", "NoDaemon", "Refused"]


def __getattr__(name: str) -> Any:
    """Import asyncio only for those who use it: it would double the time that fishctl takes."""
    if name == "AsyncFish":
        from fishd.client.asynchronous import AsyncFish

        return AsyncFish
    raise AttributeError(f"module 'fishd.client' has no attribute '{name}'")
