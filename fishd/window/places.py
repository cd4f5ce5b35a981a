"""Places of connections: however many are opened, an emergency stop finds one.

A connection that has sent nothing costs a descriptor and no more: the HTTP server sees it once its
first byte is there, so thousands of them a second do not take the processor.
"""

import asyncio
import socket
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from ipaddress import IPv4Address, IPv6Address, ip_address

from aiohttp import web

PLACES = 256
"""Largest number of connections of each group of senders; a further one replaces one of them."""
MAX_PAIRED_ADDRESSES = 200
MAX_ACCEPTED = 16
"""Largest number of connections that are accepted before others are served."""
ACCEPT_PAUSE_S = 1.0
"""Time until connections are accepted again after a failure, such as no free descriptor [s]."""


class _Place:
    """Place that a connection takes."""

    def __init__(self, connection: socket.socket, address: str) -> None:
        self.connection, self.address = connection, address
        self.timeout: asyncio.TimerHandle | None = None
        """End of a connection that sends nothing; None once it has sent something."""
        self.transport: asyncio.Transport | None = None
        self.handler: web.RequestHandler | None = None
        """Protocol that serves it; None until it has sent something."""
        self.is_kept = False
        """Whether other connections are ended before this one."""
        self.is_ended = False

    @property
    def is_taken(self) -> bool:
        """Whether the connection still exists; one that closes may have to send its answer."""
        transport = self.transport
        return not transport or not transport.is_closing() or transport.get_write_buffer_size() > 0

    def wait(self, seconds: float, begin: Callable[["_Place"], None], end: "_End") -> None:
        """Wait for the first byte, at most for this time [s]."""
        loop = asyncio.get_running_loop()
        self.timeout = loop.call_later(seconds, end, self)
        loop.add_reader(self.connection, begin, self)

    def stop_waiting(self) -> None:
        """Leave the connection to another reader."""
        if self.timeout:
            self.timeout.cancel()
            asyncio.get_running_loop().remove_reader(self.connection)
            self.timeout = None

    def end(self) -> None:
        """End the connection at once; while its transport is created, `_Door` does so."""
        self.is_ended = True
        if self.transport:
            self.transport.abort()
        elif self.timeout:
            self.stop_waiting()
            self.connection.close()


_End = Callable[[_Place], None]


class _Group:
    """Places of one group of senders, the oldest first."""

    def __init__(self) -> None:
        self.places: dict[_Place, None] = {}
        self._counts = Counter[str]()
        """Number of places of each address."""

    def add(self, place: _Place) -> None:
        """Give a place to a connection, and end another one if there is none."""
        if len(self.places) >= PLACES:
            self._make_room()
        self.places[place] = None
        self._counts[place.address] += 1

    def remove(self, place: _Place) -> None:
        """Let a connection no longer take a place."""
        if place in self.places:
            del self.places[place]
            self._counts[place.address] -= 1
            if not self._counts[place.address]:
                del self._counts[place.address]

    def end(self, place: _Place) -> None:
        """End a connection."""
        self.remove(place)
        place.end()

    def _make_room(self) -> None:
        """End the connection that `Places` describes, unless another one has ended already."""
        victim, lowest = None, (True, 1)
        for place in self.places:
            if not place.is_taken:
                self.remove(place)
                return
            rank = (place.is_kept, -self._counts[place.address])
            if rank < lowest:
                victim, lowest = place, rank
        assert victim
        self.end(victim)


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
        self._listeners: list[socket.socket] = []
        self._opening: set[asyncio.Task[object]] = set()

    def open(
        self,
        listeners: Iterable[socket.socket],
        create: Callable[[], web.RequestHandler],
        timeout: float,
    ) -> None:
        """Accept connections.

        listeners: listening sockets, which this object closes
        create: returns the protocol of a connection that has sent something
        timeout: longest time until a connection has sent something [s]
        """
        self._create, self._timeout = create, timeout
        self._listeners += listeners
        for listener in self._listeners:
            self._listen(listener)

    def close(self) -> None:
        """Accept no more connections, and end those that have sent nothing."""
        for listener in self._listeners:
            asyncio.get_running_loop().remove_reader(listener)
            listener.close()
        for group in self._groups:
            for place in [place for place in group.places if place.timeout]:
                group.end(place)

    def reserve(self, address: str) -> None:
        """Let connections from the address of a paired device have the places of that group."""
        self._paired.pop(address, None)
        self._paired[address] = None
        if len(self._paired) > MAX_PAIRED_ADDRESSES:
            del self._paired[next(iter(self._paired))]

    def keep(self, handler: web.RequestHandler) -> None:
        """End this connection last."""
        for group in self._groups:
            for place in group.places:
                if place.handler is handler:
                    place.is_kept = True

    def leave(self, handler: web.RequestHandler) -> None:
        """Let a connection no longer take a place."""
        for group in self._groups:
            for place in [place for place in group.places if place.handler is handler]:
                group.remove(place)

    def _listen(self, listener: socket.socket) -> None:
        if listener.fileno() >= 0:
            asyncio.get_running_loop().add_reader(listener, self._accept, listener)

    def _accept(self, listener: socket.socket) -> None:
        """Admit connections that have come, a few at a time."""
        for _ in range(MAX_ACCEPTED):
            try:
                connection, peer = listener.accept()
            except (BlockingIOError, ConnectionAbortedError):
                return
            except OSError:
                loop = asyncio.get_running_loop()
                loop.remove_reader(listener)
                loop.call_later(ACCEPT_PAUSE_S, self._listen, listener)
                return
            connection.setblocking(False)
            place, group = _Place(connection, str(peer[0])), self._find_group(str(peer[0]))
            group.add(place)
            place.wait(self._timeout, partial(self._begin, group), group.end)

    def _begin(self, group: _Group, place: _Place) -> None:
        """Serve a connection that has sent something, or has ended."""
        first = b""
        with suppress(OSError):
            first = place.connection.recv(1, socket.MSG_PEEK)
        if not first:
            group.end(place)
            return
        place.stop_waiting()
        loop = asyncio.get_running_loop()
        door = partial(_Door, place, self._create)
        opening = loop.create_task(loop.connect_accepted_socket(door, place.connection))
        self._opening.add(opening)
        opening.add_done_callback(self._opening.discard)

    def _find_group(self, address: str) -> _Group:
        if is_loopback(address):
            return self._here
        return self._paired_devices if address in self._paired else self._others


class _Door(asyncio.Protocol):
    """Protocol of a connection until it has a transport; another one may have its place by then."""

    def __init__(self, place: _Place, create: Callable[[], web.RequestHandler]) -> None:
        self._place, self._create = place, create

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Serve the connection."""
        assert isinstance(transport, asyncio.Transport)
        self._place.transport = transport
        if self._place.is_ended:
            transport.abort()
            return
        self._place.handler = handler = self._create()
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
