"""What is an address that a ZeroMQ socket of fishd can bind or connect to."""

import os
import re

LONGEST_SOCKET = 107
"""Of the path of a Unix socket, by Linux [bytes]."""
_ADDRESS = re.compile(r"tcp://[^/\s]+:(?P<port>[0-9]+)|ipc://[^@\s]\S*")
_TCP = re.compile(r"tcp://(?P<host>[^/\s]+):(?P<port>[0-9]+|\*)")
_IPC = re.compile(r"ipc://(?P<path>[^@*\s]\S*)")
_HOST = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*|\[[0-9A-Fa-f:.]+(%\w+)?\]", re.ASCII)
_FORM = "tcp://HOST:PORT or ipc://PATH is needed"


def is_address(text: str) -> bool:
    """Is it tcp://HOST:PORT or ipc://PATH?"""
    found = _ADDRESS.fullmatch(text)
    return found is not None and int(found["port"] or 0) < 65536


def why_not_bound(text: str) -> str:
    """Why an agent cannot bind this, tcp://HOST:PORT or ipc://PATH; empty where it can.

    Host and port may be *.
    """
    tcp, ipc = _TCP.fullmatch(text), _IPC.fullmatch(text)
    if ipc:
        return _too_long(ipc["path"])
    if not tcp:
        return _FORM
    return "" if tcp["port"] == "*" else _no_port(tcp["port"])


def why_not_connected(text: str) -> str:
    """Why nothing can connect to this, tcp://HOST:PORT or ipc://PATH; empty where it can."""
    tcp, ipc = _TCP.fullmatch(text), _IPC.fullmatch(text)
    if ipc:
        return _too_long(ipc["path"])
    if not tcp:
        return _FORM
    host, port = tcp["host"], tcp["port"]
    if host == "*":
        return f"{_FORM}; * is what an agent binds, here give the host that it runs on"
    if not _HOST.fullmatch(host):
        return f"{_FORM}; '{host}' is no host"
    if port == "*" or int(port) == 0:
        return f"{_FORM}; {port} is what an agent binds, here give the port that it was given"
    complaint = _no_port(port)
    return complaint and f"{_FORM}; {complaint}"


def _no_port(port: str) -> str:
    return "" if int(port) < 65536 else f"{port} is no port, 65535 is the highest"


def _too_long(path: str) -> str:
    length = len(os.fsencode(path))
    if length <= LONGEST_SOCKET:
        return ""
    return (
        f"the path of a Unix socket has at most {LONGEST_SOCKET} bytes, this one has {length}; "
        "choose a shorter one, such as in /run or /tmp"
    )
