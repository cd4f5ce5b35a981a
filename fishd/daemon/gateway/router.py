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
_REQUESTS_PER_TURN = 20
"""Number of requests that are read before replies are read."""


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
        self._urgent: deque[bytes] = deque()
        self._waiting: dict[bytes, deque[bytes]] = {}
        """Other waiting requests by their client; the client whose turn is next comes first."""
        self._envelopes: dict[int, list[bytes]] = {}
        """Envelopes for the replies, by the number of the request."""
        self._open = 0
        self._replies = Replies()
        self._number = 0
        """Time when the latest request arrived [ns, monotonic], made unique."""

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
        """Queue a request, or refuse it."""
        queue = self._waiting.get(envelope[0], deque())
        try:
            operation = protocol.decode_request(payload).op
            if self._known:
                self._known.check(key, operation)
            # A flood of urgent requests must not displace the others.
            if operation in URGENT_OPERATIONS and len(self._urgent) < MAX_OPEN_REQUESTS:
                queue = self._urgent
            elif len(queue) >= max(1, MAX_WAITING_REQUESTS // max(1, len(self._waiting))):
                why = f"{len(queue)} of your requests are already waiting; slow down"
                raise Refused("busy", why)
        except Refused as error:
            self._answer(envelope, protocol.failure(protocol.request_id(payload), error))
            return
        self._number = max(self._number + 1, time.monotonic_ns())
        self._envelopes[self._number] = envelope
        queue.append(request(self._number, payload))
        if queue is not self._urgent:
            self._waiting[envelope[0]] = queue

    def pass_on(self) -> None:
        """Send waiting requests to fishd, as many as may be open at a time; clients take turns."""
        while self._urgent or self._waiting:
            if self._open >= MAX_OPEN_REQUESTS + MAX_EXTRA_URGENT * bool(self._urgent):
                return
            client, queue = b"", self._urgent
            if not queue:
                client, queue = next(iter(self._waiting.items()))
            try:
                self._link.send(queue[0])
            except BlockingIOError:
                return
            self._open += 1
            queue.popleft()
            if queue is not self._urgent:
                del self._waiting[client]
                if queue:
                    self._waiting[client] = queue  # after all others

    def _answer(self, envelope: list[bytes], payload: bytes) -> None:
        # Never blocks: ROUTER drops the messages that a client does not read.
        self._server.send_multipart([*envelope, payload], zmq.DONTWAIT)
