"""ZeroMQ sockets of clients: for telemetry, and times to wait for them."""

import logging
import math
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import zmq

from fishd.core.addresses import is_ipv6
from fishd.core.errors import NoDaemon
from fishd.core.names import find_name_problem

if TYPE_CHECKING:
    from fishd.client.connection import Connection
    from fishd.core.keys import Access

log = logging.getLogger(__name__)

S = TypeVar("S", bound="zmq.Socket[Any]")

STATUS = b"status"
"""Topic of the status."""
TELEMETRY_TIMEOUT_S = 3.0
"""Time without any message after which a connection of telemetry counts as dead [s]: fishd
publishes a status every second, and fishd-camera its state twice a second."""
CONFIRMATION_S = 0.5
"""Time between two looks at a silent connection before it is replaced [s]: if this process was
itself suspended, messages have arrived, but no thread has read them yet."""


class Subscription(Generic[S]):
    """Subscription that connects again where its connection has died without an end.

    A router that was restarted, or a tunnel that hangs, forgets a connection, and neither end
    learns of it: only silence shows it. ZeroMQ's own heartbeats cannot be used, because libzmq
    4.3.5 aborts the process of a subscriber that reads too slowly while it uses them ("Assertion
    failed: _input_stopped").
    """

    def __init__(
        self,
        connect: Callable[[str], S],
        address: str,
        source: str,
        report: Callable[[str], object] = log.warning,
    ) -> None:
        """
        connect: opens a socket at an address that subscribes to the status, too, as a heartbeat
        source: the publisher, for messages
        report: called with a line when the connection is replaced, and when messages come again
        """
        self._connect, self._source, self._report = connect, source, report
        self.address = address
        self.socket = connect(address)
        self.heard = self._opened = time.monotonic()
        """Time of the latest message [s, monotonic]."""
        self._suspected = math.inf
        self.was_replaced = False
        """Whether the connection was replaced since the latest message."""

    def hear(self) -> None:
        """Note a message; call it for every one."""
        now = time.monotonic()
        if self.was_replaced:
            silence = now - self.heard
            self._report(
                f"telemetry of {self._source} arrives again; that of {silence:.1f} s is lost"
            )
        self.heard = self._opened = now
        self._suspected, self.was_replaced = math.inf, False

    def is_dead(self) -> bool:
        """Return whether to connect again; call it only while no message waits."""
        now = time.monotonic()
        if now - self._opened < TELEMETRY_TIMEOUT_S:
            return False
        self._suspected = min(self._suspected, now)
        return now - self._suspected >= CONFIRMATION_S

    def replace(self, address: str) -> None:
        """Connect again, perhaps to another address."""
        if address == self.address:
            if not self.was_replaced:
                self._report(
                    f"{self._source} answers, but nothing arrives from its telemetry at {address}; "
                    "connecting again"
                )
            self.was_replaced = True
        self.close()
        self.address, self.socket = address, self._connect(address)
        self._opened, self._suspected = time.monotonic(), math.inf

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self.socket.close()


class TelemetryReader(Subscription[S]):
    """Subscription of an iterator of `Fish` or `AsyncFish`, which waits for a limited time."""

    def __init__(
        self, fish: "Connection", connect: Callable[[str], S], address: str, timeout: float
    ) -> None:
        """timeout: time to wait for a message that the iterator returns [s]"""
        super().__init__(connect, address, f"the fishd at {fish.endpoint}")
        self._fish, self._timeout = fish, timeout
        self._deadline = time.monotonic() + timeout

    def expect_next(self) -> None:
        """Begin to wait for the next message that the iterator returns."""
        self._deadline = time.monotonic() + self._timeout

    @property
    def wait_ms(self) -> int:
        """Time to wait for a message of any kind [ms]."""
        return milliseconds_until(min(self._deadline, time.monotonic() + TELEMETRY_TIMEOUT_S))

    def check_ticks(self) -> None:
        """Raise `NoDaemon` where only other messages have come in time."""
        if time.monotonic() > self._deadline:
            raise NoDaemon(f"{self._source} has not ticked for {self._timeout:g} s")

    def handle_silence(self, address: str) -> None:
        """Connect again if fishd answers; raise `NoDaemon` if that has not helped in time.

        address: of telemetry, as fishd has just answered; empty if it has not
        """
        now = time.monotonic()
        is_overdue = now > self._deadline
        if is_overdue and not address:
            raise self._fish.no_telemetry_error(self._timeout)
        if is_overdue and self.was_replaced:
            why = find_name_problem(address) or "can this machine reach that address?"
            raise NoDaemon(
                f"{self._source} answers, but nothing arrives from its telemetry at {address}: "
                f"{why}"
            )
        if address:
            if not self.was_replaced:  # one attempt, whatever the timeout
                self._deadline = max(self._deadline, now + min(self._timeout, TELEMETRY_TIMEOUT_S))
            self.replace(address)


def connect_subscriber(
    context: "zmq.Context[S]",
    address: str,
    *topics: bytes,
    access: "Access | None" = None,
    options: Mapping[zmq.SocketOption, int] = {},
) -> S:
    """Return a socket for topics of telemetry, and for the status, which shows that it works.

    Raise `NoDaemon` if the address is invalid.

    access: keys of this client and of the fishd; None to connect without
    options: options of the socket, with their values
    """
    messages = context.socket(zmq.SUB)
    for option, value in options.items():
        messages.set(option, value)
    set_keys(messages, access)
    for topic in dict.fromkeys((*topics, STATUS)):  # the status last: it counts ticks
        messages.set(zmq.SUBSCRIBE, topic)
    try:
        messages.set(zmq.IPV6, is_ipv6(address))
        messages.connect(address)
    except zmq.ZMQError as error:
        messages.close()
        why = find_name_problem(address) or (
            f"'{address}' is not an address: {zmq.strerror(error.errno or 0)}; "
            "write ipc://PATH or tcp://HOST:PORT"
        )
        raise NoDaemon(why) from None
    return messages


def set_keys(client: "zmq.Socket[Any]", access: "Access | None") -> None:
    """Set the keys of a socket, if there are any, before it connects."""
    if access:
        secret = access.secret.encode()
        client.set(zmq.CURVE_SECRETKEY, secret)
        client.set(zmq.CURVE_PUBLICKEY, zmq.curve_public(secret))
        client.set(zmq.CURVE_SERVERKEY, access.server.encode())


def milliseconds_until(deadline: float) -> int:
    """Return the time until a deadline [s, monotonic], rounded up; 0 after it [ms]."""
    return max(0, math.ceil((deadline - time.monotonic()) * 1e3))
