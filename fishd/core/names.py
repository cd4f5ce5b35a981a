"""Explanation why the name in an address is not known."""

import socket
import threading

from fishd.core.addresses import Ipc, parse

NAME_TIMEOUT_S = 1.0
"""Longest wait for a name server [s]."""


def find_name_problem(address: str) -> str | None:
    """Return that the name in an address is not known; None if it is, or may be.

    Call it to explain why nothing answers there: it may wait for `NAME_TIMEOUT_S`.
    """
    try:
        where = parse(address)
    except ValueError:
        return None
    if isinstance(where, Ipc):
        return None
    problems: list[str] = []

    def look_up() -> None:
        try:
            socket.getaddrinfo(where.host, None, type=socket.SOCK_STREAM)
        except (socket.gaierror, UnicodeError) as error:
            problems.append(describe_name_error(where.host, error))

    thread = threading.Thread(target=look_up, name="name", daemon=True)
    thread.start()
    thread.join(NAME_TIMEOUT_S)
    return problems[0] if problems else None


def describe_name_error(host: str, error: Exception) -> str:
    """Return that a name is not known, and why; error: that of its look-up."""
    zone, why = host.partition("%")[2], ""
    if isinstance(error, socket.gaierror) and error.errno == socket.EAI_AGAIN:
        why = " (no name server answers)"
    if zone:
        why = f" (this machine has no network interface {zone})"
    return f"the name {host} is not known{why}; check its spelling, or write the address in numbers"
