"""What is an address that a ZeroMQ socket of fishd can bind or connect to.

ZeroMQ itself takes more, such as `tcp://SOURCE;HOST:PORT` and names of network interfaces. fishd
takes only what a reader of its configuration would take for the same thing.
"""

import ipaddress
import os
import re
from typing import NamedTuple

LONGEST_SOCKET = 107
"""Of the path of a Unix socket, by Linux [bytes]."""
FORM = "tcp://HOST:PORT or ipc://PATH is needed"

_TCP = re.compile(r"tcp://(?P<host>\*|[^/\s:;*\[\]]+|\[[^/\s;\[\]]*\]):(?P<port>[0-9]+|\*)", re.A)
_IPC = re.compile(r"ipc://(?P<path>[^@*\s]\S*)")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_DIGITS = re.compile(r"[0-9.]+")


class Tcp(NamedTuple):
    """`tcp://HOST:PORT`; host and port as written, the brackets of an IPv6 address taken off."""

    host: str
    port: str


class Ipc(NamedTuple):
    """`ipc://PATH`."""

    path: str


def parse(text: str) -> Tcp | Ipc:
    """The parts of an address; raises ValueError that says what is wrong with it."""
    tcp, ipc = _TCP.fullmatch(text), _IPC.fullmatch(text)
    if ipc:
        check_length(ipc["path"])
        return Ipc(ipc["path"])
    if not tcp:
        raise ValueError(FORM)
    host, port = tcp["host"], tcp["port"]
    if port != "*" and (len(port) > 5 or int(port) > 65535):
        raise ValueError(f"{FORM}; {port} is no port, 65535 is the highest")
    if host.startswith("["):
        host = host[1:-1]
        if _number(host.partition("%")[0]) is None:
            raise ValueError(f"{FORM}; '[{host}]' is no IPv6 address")
    elif host != "*" and (
        not _NAME.fullmatch(host) or (_DIGITS.fullmatch(host) and _number(host) is None)
    ):
        raise ValueError(f"{FORM}; '{host}' is no host")
    return Tcp(host, port)


def is_local(text: str) -> bool:
    """Is it certain that only this machine can reach an address?"""
    address = parse(text)
    if isinstance(address, Ipc) or address.host == "localhost":
        return True
    number = _number(address.host)
    return number is not None and number.version == 4 and number.is_loopback


def why_not_served(text: str) -> str:
    """Why fishd cannot listen there; empty where it can. A port of 0 means any that is free."""
    try:
        address = parse(text)
    except ValueError as error:
        return str(error)
    return FORM if isinstance(address, Tcp) and address.port == "*" else ""


def why_not_bound(text: str) -> str:
    """Why an agent cannot bind this, tcp://HOST:PORT or ipc://PATH; empty where it can.

    Host and port may be *.
    """
    try:
        parse(text)
    except ValueError as error:
        return str(error)
    return ""


def why_not_connected(text: str) -> str:
    """Why nothing can connect to this, tcp://HOST:PORT or ipc://PATH; empty where it can."""
    try:
        address = parse(text)
    except ValueError as error:
        return str(error)
    if isinstance(address, Ipc):
        return ""
    if address.host == "*":
        return f"{FORM}; * is what an agent binds, here give the host that it runs on"
    if address.port == "*" or int(address.port) == 0:
        return (
            f"{FORM}; {address.port} is what an agent binds, here give the port that it was given"
        )
    return ""


def _number(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def check_length(path: str) -> None:
    """Raises ValueError where the path is too long for a Unix socket."""
    length = len(os.fsencode(path))
    if length > LONGEST_SOCKET:
        raise ValueError(
            f"the path of a Unix socket has at most {LONGEST_SOCKET} bytes, this one has {length}; "
            "choose a shorter one, such as in /run or /tmp"
        )
