"""Places of connections: however many are opened, an emergency stop finds one.

A connection that has sent nothing costs a descriptor and no more: the HTTP server sees it once its
first byte is there, so thousands of them a second do not take the processor.
"""

import asyncio
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import lru_cache, partial
from ipaddress import IPv4Address, IPv6Address, ip_address
from itertools import chain

from aiohttp import web

PLACES = 256
"""Largest number of connections of each group of senders; a further one replaces one of them."""
MAX_SILENT = 64
"""Number of places of a group above which those that have sent nothing replace one another."""
MAX_PAIRED_ADDRESSES = 200
MAX_ACCEPTED = 256
"""Largest number of connections that are accepted before others are served."""
RECEIVE_BYTES = 16 * 2**10
"""Size of what a connection may send before it is read [bytes]: little is read at a time."""
ACCEPT_PAUSE_S = 1.0
"""Time until connections are accepted again after a failure, such as no free descriptor [s]."""


class _Place:
    """Place that a connection takes."""

    def __init__(self, group: "_Group", connection: socket.socket, address: str) -> None:
        self.group, self.connection, self.address = group, connection, address
        self.timeout: asyncio.TimerHandle | None = None
        """End of a connection that sends nothing; None once it has sent something."""
        self.transport: asyncio.Transport | None = None
        self.is_silent = True
        """Whether it has sent nothing yet."""
        self.is_kept = False
        """Whether other connections are ended before this one."""
        self.is_ended = False

    def wait(self, seconds: float, begin: Callable[["_Place"], None]) -> None:
        """Wait for the first byte, at most for this time [s]."""
        loop = asyncio.get_running_loop()
        self.timeout = loop.call_later(seconds, self.end)
        loop.add_reader(self.connection.fileno(), begin, self)

    def stop_waiting(self) -> None:
        """Leave the connection to another reader."""
        if self.timeout:
            self.timeout.cancel()
            asyncio.get_running_loop().remove_reader(self.connection.fileno())
            self.timeout = None

    def end(self) -> None:
        """End the connection at once; while its transport opens, `_ServedConnection` does so."""
        self.group.remove(self)
        self.is_ended = True
        if self.transport:
            self.transport.abort()
        elif self.timeout:
            self.stop_waiting()
            self.connection.close()


class _Group:
    """Places of one group of senders."""

    def __init__(self) -> None:
        self._places: dict[tuple[str, bool], dict[_Place, None]] = {}
        """Places of each address, those that are silent apart, the oldest first."""
        self._count = 0

    def __iter__(self) -> Iterator[_Place]:
        return (place for places in tuple(self._places.values()) for place in tuple(places))

    @property
    def is_full(self) -> bool:
        """Whether a further connection has no place."""
        return self._count >= PLACES

    def add(self, place: _Place) -> None:
        """Give a place to a connection."""
        self._places.setdefault((place.address, place.is_silent), {})[place] = None
        self._count += 1

    def remove(self, place: _Place) -> None:
        """Let a connection no longer take a place; may be called twice."""
        key = place.address, place.is_silent
        places = self._places.get(key, {})
        if place in places:
            del places[place]
            self._count -= 1
            if not places:
                del self._places[key]

    def find_victim(self) -> _Place:
        """Return the connection that a further one replaces, as `Places` describes."""
        silent = [places for (_, is_silent), places in self._places.items() if is_silent]
        if sum(map(len, silent)) < MAX_SILENT:  # a flood of these must not end those that speak
            silent = []
        others = [places for (_, is_silent), places in self._places.items() if not is_silent]
        busiest = max(silent or others or self._places.values(), key=len)
        free: Iterator[_Place] = (place for place in chain(busiest, self) if not place.is_kept)
        return next(chain(free, busiest))


class Places:
    """Places of the connections of a server, WebSockets aside, in three groups of senders.

    This machine, addresses of paired devices, and all others have places of their own. A connection
    that finds none replaces the oldest one of that address of its group that has most of them: its
    sender had the most time to send a request, and others are not disturbed. Where many have
    sent nothing, one of them is replaced.
    """

    def __init__(self) -> None:
        self._groups = self._here, self._paired_devices, self._others = _Group(), _Group(), _Group()
        self._paired: dict[str, None] = {}
        """Addresses from which a paired device has sent a request, the newest last."""
        self._served: dict[web.RequestHandler, _Place] = {}
        """Places of connections that have sent something, by their protocol."""
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
            for place in group:
                if place.timeout:
                    place.end()

    def reserve(self, address: str) -> None:
        """Let connections from the address of a paired device have the places of that group."""
        self._paired.pop(address, None)
        self._paired[address] = None
        if len(self._paired) > MAX_PAIRED_ADDRESSES:
            del self._paired[next(iter(self._paired))]

    def keep(self, handler: web.RequestHandler) -> None:
        """End this connection last."""
        if place := self._served.get(handler):
            place.is_kept = True

    def leave(self, handler: web.RequestHandler) -> None:
        """Let a connection no longer take a place."""
        if place := self._served.get(handler):
            place.group.remove(place)

    def serve(self, place: _Place) -> web.RequestHandler:
        """Return the protocol of a connection that has sent something."""
        handler = self._create()
        self._served[handler] = place
        return handler

    def forget(self, handler: web.RequestHandler) -> None:
        """Free the place of a connection that has ended."""
        place = self._served.pop(handler)
        place.group.remove(place)

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
            address = str(peer[0])
            place = _Place(self._find_group(address), connection, address)
            while place.group.is_full:
                victim = place.group.find_victim()
                if victim.is_silent:
                    self._begin(victim)  # what it has sent may have come now
                else:
                    victim.end()
            place.group.add(place)
            place.wait(self._timeout, self._begin)

    def _begin(self, place: _Place) -> None:
        """Serve a connection if it has sent something, else end it."""
        first = b""
        with suppress(OSError):
            first = place.connection.recv(1, socket.MSG_PEEK)
        if not first:
            place.end()
            return
        place.stop_waiting()
        place.group.remove(place)
        place.is_silent = False
        place.group.add(place)
        loop = asyncio.get_running_loop()
        protocol = partial(_ServedConnection, self, place)
        opening = loop.create_task(loop.connect_accepted_socket(protocol, place.connection))
        self._opening.add(opening)
        opening.add_done_callback(self._opening.discard)

    def _find_group(self, address: str) -> _Group:
        if is_loopback(address):
            return self._here
        return self._paired_devices if address in self._paired else self._others


class _ServedConnection(asyncio.BufferedProtocol):
    """Protocol of a connection that has sent something: that of the HTTP server, and its place.

    All connections are read into one buffer, one after the other.
    """

    _BUFFER = memoryview(bytearray(RECEIVE_BYTES))

    def __init__(self, places: Places, place: _Place) -> None:
        self._places, self._place = places, place
        self._handler: web.RequestHandler | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Serve the connection, unless another one has its place by now."""
        assert isinstance(transport, asyncio.Transport)
        self._place.transport = transport
        if self._place.is_ended:
            transport.abort()
            return
        self._handler = self._places.serve(self._place)
        self._handler.connection_made(transport)

    def connection_lost(self, error: Exception | None) -> None:
        """Free the place."""
        if self._handler:
            self._places.forget(self._handler)
            self._handler.connection_lost(error)

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return the buffer to read into."""
        return self._BUFFER

    def buffer_updated(self, nbytes: int) -> None:
        """Pass on what the connection has sent."""
        if self._handler:
            self._handler.data_received(bytes(self._BUFFER[:nbytes]))

    def eof_received(self) -> None:
        """Pass on the end of what the connection sends."""
        if self._handler:
            self._handler.eof_received()

    def pause_writing(self) -> None:
        """Pass on that the connection does not read."""
        if self._handler:
            self._handler.pause_writing()

    def resume_writing(self) -> None:
        """Pass on that the connection reads again."""
        if self._handler:
            self._handler.resume_writing()


def parse_ip(name: str) -> IPv4Address | IPv6Address | None:
    """Return an IP address; None for any other name."""
    try:
        return ip_address(name)
    except ValueError:
        return None


@lru_cache(maxsize=1024)
def is_loopback(name: str) -> bool:
    """Return whether a name is an IP address of loopback."""
    address = parse_ip(name)
    mapped = getattr(address, "ipv4_mapped", None)
    return address is not None and (mapped or address).is_loopback
