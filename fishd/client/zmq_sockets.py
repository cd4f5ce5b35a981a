"""The sockets of ZeroMQ that clients have: for telemetry, and for the requests of `AsyncFish`."""

import math
import time
from typing import Any, TypeVar

import zmq

from fishd.core.addresses import is_ipv6
from fishd.core.errors import NoDaemon

_RECONNECT_MS = 20
"""Time after which a lost connection is made again, twice as long at most [ms]."""

S = TypeVar("S", bound="zmq.Socket[Any]")


def dealer(context: "zmq.Context[S]", endpoint: str) -> S:
    """A socket for requests; raises `NoDaemon` when the endpoint is no address."""
    requests = context.socket(zmq.DEALER)
    requests.set(zmq.LINGER, 0)
    requests.set(zmq.RECONNECT_IVL, _RECONNECT_MS)
    requests.set(zmq.IMMEDIATE, 1)  # do not queue for a daemon that is not there
    _connect(requests, endpoint)
    return requests


def subscriber(context: "zmq.Context[S]", address: str, *topics: bytes) -> S:
    """A socket for topics of telemetry; raises `NoDaemon` when the address is none."""
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
            f"'{address}' is no address: {zmq.strerror(error.errno or 0)}; "
            "write ipc://PATH or tcp://HOST:PORT"
        ) from None


def milliseconds_until(deadline: float) -> int:
    """Time left until a deadline [s, monotonic], rounded up; 0 after it [ms]."""
    return max(0, math.ceil((deadline - time.monotonic()) * 1e3))
