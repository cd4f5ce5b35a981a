"""The gateway of the control channel: a ROUTER socket that lets through what fishd can bear."""

import socket
import time
from collections import deque
from contextlib import suppress

import zmq

from fishd.core import protocol
from fishd.core.errors import Refused
from fishd.daemon.gateway.limits import ResourceLimits
from fishd.daemon.gateway.link import END, LONGEST, PING, PONG, Replies, request

SOCKET = zmq.ROUTER
MEMORY = 48 * 2**20
"""Beyond what it starts with [bytes]."""
CONNECTIONS = 1500
"""Clients, and others that connect."""

QUEUE_IN, QUEUE_OUT = 8, 64
"""Requests and replies in ZeroMQ's hands for one client; further replies are dropped."""
MOST_OPEN = 16
"""Requests that fishd has and has not answered yet; more wait here."""
MOST_WAITING = 600
"""Requests that wait, of all clients together; each has its share, which is one at least."""
URGENT = {"estop", "stop"}
"""Operations that wait for no other."""
SPARE = 2
"""Requests beyond MOST_OPEN that may be open, if they are urgent."""
REFUSALS, REFUSALS_AT_ONCE = 20.0, 50.0
"""Requests of one client per second, and at once, that are refused; others get no reply."""
GREETING = 2000
"""How long a connection may take until it speaks ZeroMQ [ms]."""
_LOOK = 100
"""Longest time between two looks at the limits [ms]."""
_AT_ONCE = 20
"""Requests that are taken before replies are looked at."""
_FORGET = 10.0
"""A client that was silent for so long is forgotten [s]."""


class _Client:
    """A client's requests that wait, and how many may still be refused."""

    def __init__(self, now: float) -> None:
        self.waiting: deque[bytes] = deque()
        self.seen = now
        """When it last made a request [s, monotonic]."""
        self._refusals = REFUSALS_AT_ONCE
        self._refused = now

    def may_refuse(self, now: float) -> bool:
        """Is this refusal answered? Not where the client goes on whatever it is told."""
        gained = (now - self._refused) * REFUSALS
        self._refusals = min(REFUSALS_AT_ONCE, self._refusals + gained)
        self._refused = now
        if self._refusals < 1.0:
            return False
        self._refusals -= 1.0
        return True


class Router:
    """Passes requests from a ROUTER socket to the link to fishd; clients take turns."""

    def __init__(
        self, link: socket.socket, server: "zmq.Socket[bytes]", limits: ResourceLimits
    ) -> None:
        self._link = link
        self._server = server
        self._limits = limits
        self._clients: dict[bytes, _Client] = {}
        self._urgent: deque[bytes] = deque()
        self._turns: deque[_Client] = deque()
        """Clients with requests that wait, the next one first."""
        self._envelopes: dict[int, list[bytes]] = {}
        """What the reply to a request needs, by its number."""
        self._open = 0
        self._replies = Replies()
        self._number = 0
        """When the latest request came [ns, monotonic]; no two have the same."""
        self._next_purge = 0.0
        self._ended = False

    def run(self) -> str:
        """Pass requests and replies on until fishd ends; returns which limit was exceeded."""
        poller = zmq.Poller()
        poller.register(self._link, zmq.POLLIN)
        poller.register(self._server, zmq.POLLIN)
        while not (self._ended or (why := self._limits.exceeded())):
            ready = dict(poller.poll(_LOOK))
            if self._link.fileno() in ready:
                self._take_replies()
            if self._server in ready:
                self._take_requests()
            self._pass_on()
            self._forget_silent_clients()
        return "" if self._ended else why

    def _take_replies(self) -> None:
        while not self._ended:
            try:
                message = self._link.recv(2 * LONGEST)
            except BlockingIOError:
                return
            except ConnectionResetError:  # fishd was killed
                message = b""
            if message in (b"", END):
                self._ended = True
                return
            if message == PING:
                with suppress(OSError):  # of a fishd that was killed, the next look tells
                    self._link.send(PONG)
                continue
            found = self._replies.take(message)
            if found:
                number, payload = found
                envelope = self._envelopes.pop(number, None)
                if envelope:  # else the gateway before this one was asked
                    self._open -= 1
                    self._answer(envelope, payload)

    def _take_requests(self) -> None:
        for _ in range(_AT_ONCE):
            try:
                frames = self._server.recv_multipart(zmq.DONTWAIT)
            except zmq.Again:
                return
            envelope, payload = frames[:-1], frames[-1]
            if len(envelope) == 1 or (len(envelope) == 2 and not envelope[1]):
                self._take(envelope, payload)

    def _take(self, envelope: list[bytes], payload: bytes) -> None:
        now = time.monotonic()
        client = self._clients.get(envelope[0])
        if client is None:
            client = self._clients[envelope[0]] = _Client(now)
        client.seen = now
        try:
            urgent = protocol.decode_request(payload).op in URGENT
            urgent = urgent and len(self._urgent) < MOST_OPEN  # of a flood of them, these will do
            waiting = len(client.waiting)
            if waiting >= max(1, MOST_WAITING // max(1, len(self._turns))) and not urgent:
                raise Refused("busy", f"{waiting} of your requests wait already; slow down")
        except Refused as error:
            if client.may_refuse(now):
                self._answer(envelope, protocol.failure(protocol.request_id(payload), error))
            return
        self._number = max(self._number + 1, time.monotonic_ns())
        self._envelopes[self._number] = envelope
        message = request(self._number, payload)
        if urgent:
            self._urgent.append(message)
            return
        if not client.waiting:
            self._turns.append(client)
        client.waiting.append(message)

    def _pass_on(self) -> None:
        while self._urgent or self._turns:
            if self._open >= MOST_OPEN + SPARE * bool(self._urgent):
                return
            waiting = self._urgent or self._turns[0].waiting
            try:
                self._link.send(waiting[0])
            except BlockingIOError:
                return
            except OSError:
                self._ended = True
                return
            self._open += 1
            waiting.popleft()
            if waiting is not self._urgent:
                client = self._turns.popleft()
                if client.waiting:
                    self._turns.append(client)

    def _answer(self, envelope: list[bytes], payload: bytes) -> None:
        # Never blocks: ROUTER drops what a client does not take.
        self._server.send_multipart([*envelope, payload], zmq.DONTWAIT)

    def _forget_silent_clients(self) -> None:
        now = time.monotonic()
        if now >= self._next_purge:
            self._next_purge = now + _FORGET
            self._clients = {
                name: client
                for name, client in self._clients.items()
                if client.waiting or now - client.seen < _FORGET
            }


def configure(server: "zmq.Socket[bytes]") -> None:
    """What holds for every client."""
    server.set(zmq.RCVHWM, QUEUE_IN)
    server.set(zmq.SNDHWM, QUEUE_OUT)
    server.set(zmq.MAXMSGSIZE, protocol.MAX_MESSAGE)
    server.set(zmq.HANDSHAKE_IVL, GREETING)


def run(link: socket.socket, server: "zmq.Socket[bytes]", limits: ResourceLimits) -> str:
    """Pass requests and replies on until fishd ends; returns which limit was exceeded."""
    return Router(link, server, limits).run()
