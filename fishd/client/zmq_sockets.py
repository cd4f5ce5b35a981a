"""ZeroMQ sockets of clients: for telemetry, and times to wait for them."""

import math
import time
from typing import TYPE_CHECKING, Any, TypeVar

import zmq

from fishd.core.addresses import is_ipv6
from fishd.core.errors import NoDaemon

if TYPE_CHECKING:
    from fishd.core.keys import Access

S = TypeVar("S", bound="zmq.Socket[Any]")


def connect_subscriber(
    context: "zmq.Context[S]", address: str, *topics: bytes, access: "Access | None" = None
) -> S:
    """Return a socket for topics of telemetry; raise `NoDaemon` if the address is invalid.

    access: keys of this client and of the fishd; None to connect without
    """
    messages = context.socket(zmq.SUB)
    set_keys(messages, access)
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
