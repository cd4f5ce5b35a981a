"""Requests from a ROUTER socket to fishd, in a limited number, and the replies to them."""

import socket
import time
from collections import deque
from typing import TYPE_CHECKING

import zmq

from fishd.core import protocol
from fishd.core.errors import Refused
from fishd.daemon.gateway.link import Replies, request

if TYPE_CHECKING:
    from fishd.daemon.gateway.keys import KnownKeys

MAX_OPEN_REQUESTS = 16
"""Largest number of requests that fishd has not answered yet; further requests wait here."""
MAX_WAITING_REQUESTS = 600
"""Largest number of waiting requests of all clients; each has an equal share of at least one."""
URGENT_OPERATIONS = {"estop", "stop"}
"""Operations that do not wait for others."""
MAX_EXTRA_URGENT = 2
"""Number of urgent requests that may be open in addition to MAX_OPEN_REQUESTS."""
MAX_REFUSAL_RATE, MAX_REFUSAL_BURST = 20.0, 50.0
"""Refusals to one client: largest rate [1/s] and burst; further requests get no reply."""
_REQUESTS_PER_TURN = 20
"""Number of requests that are read before replies are read."""
_CLIENT_TIMEOUT_S = 10.0
"""Time after which a silent client is forgotten [s]."""


class _Client:
    """Waiting requests of a client, and the number of refusals that it may still get."""

    def __init__(self, now: float) -> None:
        self.waiting: deque[bytes] = deque()
        self.seen = now
        """Time of its latest request [s, monotonic]."""
        self._refusals = MAX_REFUSAL_BURST
        self._refused = now

    def may_refuse(self, now: float) -> bool:
        """Return whether to answer with a refusal; not if the client ignores earlier ones."""
        gained = (now - self._refused) * MAX_REFUSAL_RATE
        self._refusals = min(MAX_REFUSAL_BURST, self._refusals + gained)
        self._refused = now
        if self._refusals < 1.0:
            return False
        self._refusals -= 1.0
        return True


class Router:
    """Router of requests from a ROUTER socket to the link to fishd; clients take turns."""

    def __init__(
        self,
        link: socket.socket,
        server: "zmq.Socket[bytes]",
        known: "KnownKeys | None",
    ) -> None:
        self._link = link
        self._server = server
        self._known = known
        self._clients: dict[bytes, _Client] = {}
        self._urgent: deque[bytes] = deque()
        self._turns: deque[_Client] = deque()
        """Clients with waiting requests, the next one first."""
        self._envelopes: dict[int, list[bytes]] = {}
        """Envelopes for the replies, by the number of the request."""
        self._open = 0
        self._replies = Replies()
        self._number = 0
        """Time when the latest request arrived [ns, monotonic], made unique."""
        self._next_purge = 0.0

    def take_reply(self, message: bytes) -> None:
        """Pass a reply of fishd, or a part of one, on to its client."""
        if reply := self._replies.take(message):
            number, payload = reply
            envelope = self._envelopes.pop(number, None)
            if envelope:  # otherwise the request came through an earlier gateway
                self._open -= 1
                self._answer(envelope, payload)

    def take_requests(self) -> None:
        """Read some of the waiting requests; refuse those that are wrong or too many."""
        for _ in range(_REQUESTS_PER_TURN):
            try:
                if self._known:
                    messages = self._server.recv_multipart(zmq.DONTWAIT, copy=False)
                    frames = [message.bytes for message in messages]
                    key = str(messages[-1].get("User-Id"))
                else:
                    frames, key = self._server.recv_multipart(zmq.DONTWAIT), ""
            except zmq.Again:
                return
            envelope, payload = frames[:-1], frames[-1]
            if len(envelope) == 1 or (len(envelope) == 2 and not envelope[1]):
                self._take(envelope, payload, key)

    def _take(self, envelope: list[bytes], payload: bytes, key: str) -> None:
        now = time.monotonic()
        client = self._clients.get(envelope[0])
        if client is None:
            client = self._clients[envelope[0]] = _Client(now)
        client.seen = now
        try:
            operation = protocol.decode_request(payload).op
            if self._known:
                self._known.check(key, operation)
            # A flood of urgent requests must not displace the others.
            urgent = operation in URGENT_OPERATIONS and len(self._urgent) < MAX_OPEN_REQUESTS
            waiting = len(client.waiting)
            if waiting >= max(1, MAX_WAITING_REQUESTS // max(1, len(self._turns))) and not urgent:
                raise Refused("busy", f"{waiting} of your requests are already waiting; slow down")
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

    def pass_on(self) -> None:
        """Send waiting requests to fishd, as many as may be open at a time."""
        self._forget_silent_clients()
        while self._urgent or self._turns:
            if self._open >= MAX_OPEN_REQUESTS + MAX_EXTRA_URGENT * bool(self._urgent):
                return
            waiting = self._urgent or self._turns[0].waiting
            try:
                self._link.send(waiting[0])
            except BlockingIOError:
                return
            self._open += 1
            waiting.popleft()
            if waiting is not self._urgent:
                client = self._turns.popleft()
                if client.waiting:
                    self._turns.append(client)

    def _answer(self, envelope: list[bytes], payload: bytes) -> None:
        # Never blocks: ROUTER drops the messages that a client does not read.
        self._server.send_multipart([*envelope, payload], zmq.DONTWAIT)

    def _forget_silent_clients(self) -> None:
        now = time.monotonic()
        if now >= self._next_purge:
            self._next_purge = now + _CLIENT_TIMEOUT_S
            self._clients = {
                name: client
                for name, client in self._clients.items()
                if client.waiting or now - client.seen < _CLIENT_TIMEOUT_S
            }
