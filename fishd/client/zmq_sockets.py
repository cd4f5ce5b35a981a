"""ZeroMQ sockets of clients: for telemetry, and for the requests of `AsyncFish`."""

import math
import time
from typing import Any, TypeVar

import zmq

from fishd.core.addresses import is_ipv6
from fishd.core.errors import NoDaemon

_RECONNECT_MS = 20
"""Time after which a lost connection is established again, at most twice as long [ms]."""

S = TypeVar("S", bound="zmq.Socket[Any]")


def connect_dealer(context: "zmq.Context[S]", endpoint: str) -> S:
    """Return a socket for requests; raise `NoDaemon` if the endpoint is not an address."""
    requests = context.socket(zmq.DEALER)
    requests.set(zmq.LINGER, 0)
    requests.set(zmq.RECONNECT_IVL, _RECONNECT_MS)
    requests.set(zmq.IMMEDIATE, 1)  # do not queue requests without a connection
    _connect(requests, endpoint)
    return requests


def connect_subscriber(context: "zmq.Context[S]", address: str, *topics: bytes) -> S:
    """Return a socket for topics of telemetry; raise `NoDaemon` if the address is invalid."""
    messages = context.socket(zmq.SUB)
    for topic in topics:
        messages.set(zmq.SUBSCRIBE, topic)
    _connect(messages, address)
    return messages


def _connect(client: "zmq.Socket[Any]", address: str) -> None:
    try:
        client.set(zmq.IPV6, is_ipv6(address))
        client.connect(address)
    except zmq.ZMQError as error:
        client.close()
        raise NoDaemon(
            f"'{address}' is not an address: {zmq.strerror(error.errno or 0)}; "
            "write ipc://PATH or tcp://HOST:PORT"
        ) from None


def milliseconds_until(deadline: float) -> int:
    """Return the time until a deadline [s, monotonic], rounded up; 0 after it [ms]."""
    return max(0, math.ceil((deadline - time.monotonic()) * 1e3))
