"""Explanation why the name in an address is not known."""

import socket
import threading

from fishd.core.addresses import Ipc, parse

NAME_TIMEOUT_S = 1.0
"""Longest wait for a name server [s]."""


def find_name_problem(address: str) -> str:
    """Return that the name in an address is not known; empty if it is, or may be.

    Call it to explain why nothing answers there: it may wait for `NAME_TIMEOUT_S`.
    """
    try:
        where = parse(address)
    except ValueError:
        return ""
    if isinstance(where, Ipc):
        return ""
    problems: list[str] = []

    def look_up() -> None:
        try:
            socket.getaddrinfo(where.host, None, type=socket.SOCK_STREAM)
        except socket.gaierror as error:
            is_unsure = error.errno == socket.EAI_AGAIN
            problems.append("no name server answers" if is_unsure else "")
        except UnicodeError:
            problems.append("")

    thread = threading.Thread(target=look_up, name="name", daemon=True)
    thread.start()
    thread.join(NAME_TIMEOUT_S)
    if not problems:
        return ""
    zone = where.host.partition("%")[2]
    why = f"this machine has no network interface {zone}" if zone else problems[0]
    reason = f" ({why})" if why else ""
    return (
        f"the name {where.host} is not known{reason}; check its spelling, or write the address "
        "in numbers"
    )
