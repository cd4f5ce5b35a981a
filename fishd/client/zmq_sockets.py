"""ZeroMQ sockets of clients: for telemetry, and times to wait for them."""

import math
import time
from typing import Any, TypeVar

import zmq

from fishd.core.addresses import is_ipv6
from fishd.core.errors import NoDaemon

S = TypeVar("S", bound="zmq.Socket[Any]")


def connect_subscriber(context: "zmq.Context[S]", address: str, *topics: bytes) -> S:
    """Return a socket for topics of telemetry; raise `NoDaemon` if the address is invalid."""
    messages = context.socket(zmq.SUB)
    for topic in topics:
        messages.set(zmq.SUBSCRIBE, topic)
    try:
        messages.set(zmq.IPV6, is_ipv6(address))
        messages.connect(address)
    except zmq.ZMQError as error:
        messages.close()
        raise NoDaemon(
            f"'{address}' is not an address: {zmq.strerror(error.errno or 0)}; "
            "write ipc://PATH or tcp://HOST:PORT"
        ) from None
    return messages


def milliseconds_until(deadline: float) -> int:
    """Return the time until a deadline [s, monotonic], rounded up; 0 after it [ms]."""
    return max(0, math.ceil((deadline - time.monotonic()) * 1e3))
