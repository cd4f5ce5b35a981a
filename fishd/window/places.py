"""Places of connections: however many are opened, an emergency stop finds one."""

import asyncio
from collections import Counter
from collections.abc import Callable
from ipaddress import IPv4Address, IPv6Address, ip_address

from aiohttp import web
from msgspec import Struct

PLACES = 256
"""Largest number of connections of each group of senders; a further one replaces one of them."""
MAX_PAIRED_ADDRESSES = 200


class _Place(Struct, eq=False):
    """Place that a connection takes."""

    transport: asyncio.Transport
    address: str
    is_kept: bool = False
    """Whether other connections are ended before this one."""

    @property
    def is_taken(self) -> bool:
        """Whether the connection still exists; one that closes may have to send its answer."""
        return not self.transport.is_closing() or self.transport.get_write_buffer_size() > 0


class _Group:
    """Places of one group of senders, the oldest first."""

    def __init__(self) -> None:
        self._places: dict[web.RequestHandler, _Place] = {}
        self._counts = Counter[str]()
        """Number of places of each address."""

    def find(self, handler: web.RequestHandler) -> _Place | None:
        """Return the place of a connection."""
        return self._places.get(handler)

    def add(self, handler: web.RequestHandler, place: _Place) -> None:
        """Give a place to a connection, and end another one if there is none."""
        if len(self._places) >= PLACES:
            self._make_room()
        self._places[handler] = place
        self._counts[place.address] += 1

    def remove(self, handler: web.RequestHandler) -> None:
        """Let a connection no longer take a place."""
        if place := self._places.pop(handler, None):
            self._counts[place.address] -= 1
            if not self._counts[place.address]:
                del self._counts[place.address]

    def _make_room(self) -> None:
        """End the connection that `Places` describes, unless another one has ended already."""
        victim, lowest = None, (True, 1)
        for handler, place in self._places.items():
            if not place.is_taken:
                self.remove(handler)
                return
            rank = (place.is_kept, -self._counts[place.address])
            if rank < lowest:
                victim, lowest = handler, rank
        assert victim
        transport = self._places[victim].transport
        self.remove(victim)
        transport.abort()


class Places:
    """Places of the connections of a server, WebSockets aside, in three groups of senders.

    This machine, addresses of paired devices, and all others have places of their own. A connection
    that finds none replaces the oldest one of that address of its group that has most of them: its
    sender had the most time to send a request, and others are not disturbed.
    """

    def __init__(self) -> None:
        self._groups = self._here, self._paired_devices, self._others = _Group(), _Group(), _Group()
        self._paired: dict[str, None] = {}
        """Addresses from which a paired device has sent a request, the newest last."""

    def protocol(self, create: Callable[[], web.RequestHandler]) -> asyncio.Protocol:
        """Return the protocol of a new connection; `create` returns that of an admitted one."""
        return _Door(self, create)

    def reserve(self, address: str) -> None:
        """Let connections from the address of a paired device have the places of that group."""
        self._paired.pop(address, None)
        self._paired[address] = None
        if len(self._paired) > MAX_PAIRED_ADDRESSES:
            del self._paired[next(iter(self._paired))]

    def keep(self, handler: web.RequestHandler) -> None:
        """End this connection last."""
        for group in self._groups:
            if place := group.find(handler):
                place.is_kept = True

    def leave(self, handler: web.RequestHandler) -> None:
        """Let a connection no longer take a place."""
        for group in self._groups:
            group.remove(handler)

    def admit(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        """Give a place to a new connection, and end another one if there is none."""
        address = str((transport.get_extra_info("peername") or ("",))[0])
        self._find_group(address).add(handler, _Place(transport, address))

    def _find_group(self, address: str) -> _Group:
        if is_loopback(address):
            return self._here
        return self._paired_devices if address in self._paired else self._others


class _Door(asyncio.Protocol):
    """Protocol of a connection until it is admitted, which depends on its address."""

    def __init__(self, places: Places, create: Callable[[], web.RequestHandler]) -> None:
        self._places, self._create = places, create

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Admit the connection."""
        assert isinstance(transport, asyncio.Transport)
        handler = self._create()
        self._places.admit(handler, transport)
        transport.set_protocol(handler)
        handler.connection_made(transport)


def parse_ip(name: str) -> IPv4Address | IPv6Address | None:
    """Return an IP address; None for any other name."""
    try:
        return ip_address(name)
    except ValueError:
        return None


def is_loopback(name: str) -> bool:
    """Return whether a name is an IP address of loopback."""
    address = parse_ip(name)
    mapped = getattr(address, "ipv4_mapped", None)
    return address is not None and (mapped or address).is_loopback
