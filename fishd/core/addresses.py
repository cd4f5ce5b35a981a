"""Addresses: which texts are one, where fishd's sockets are, and how to listen there.

ZeroMQ takes more than fishd does, such as `tcp://SOURCE;HOST:PORT` and names of network
interfaces. fishd takes only what means to ZeroMQ what it means to a reader of the configuration.
"""

import errno
import ipaddress
import os
import re
import socket
import stat
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple

from fishd.core.errors import StartupError
from fishd.core.process import unix_sockets
from fishd.core.process.runtime_folder import runtime_folder

FORM = "tcp://HOST:PORT or ipc://PATH is needed"
ENDPOINT_VARIABLE = "FISHD_ENDPOINT"
IN_USE = "it is in use, by another fishd perhaps; end that, or choose another address"
_SERVICE = Path("/run/fishd/control")
_BACKLOG = 128
"""Connections that may wait to be accepted."""

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
    """The parts of an address; host and port may be `*`. Raises ValueError that says why not."""
    tcp, ipc = _TCP.fullmatch(text), _IPC.fullmatch(text)
    if ipc:
        unix_sockets.check_length(ipc["path"])
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


def _number(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def is_ipv6(text: str) -> bool:
    """Must a socket be told to speak IPv6? One that does looks names up as IPv6, too."""
    return "[" in text


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


def why_not_connected(text: str) -> str:
    """Why nothing can connect to this address; empty where something can."""
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


def socket_path(address: str) -> Path | None:
    """The file of an ipc address; None for any other address."""
    path = address.removeprefix("ipc://")
    return Path(path) if path != address else None


def estop_path(control: str) -> Path | None:
    """Return fishd's own socket for an emergency stop; None where control is not a Unix socket."""
    path = socket_path(control)
    return path.with_name(f"{path.name}.estop") if path else None


def control_address() -> str:
    """The default address for a daemon; makes its folder where that is fishd's own business.

    Raises `StartupError` when the folder could be somebody else's trap.
    """
    return f"ipc://{_guarded(_private_socket('control'), 'control.address')}"


def virtual_pi_socket(configured: str | None) -> Path:
    """Where the virtual Pi is reached; makes the default's folder, as for `control_address`."""
    if configured is not None:
        return Path(configured)
    return _guarded(_private_socket("virtual-pi"), "virtual_pi.socket")


def _private_socket(name: str) -> Path:
    return Path(runtime_folder()) / name


def _guarded(path: Path, key: str) -> Path:
    """The path of a socket, once its folder is there and belongs to this user."""
    folder = path.parent
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.stat(follow_symlinks=False)
    except OSError as error:
        raise StartupError(
            f"{folder}: cannot be made: {error.strerror}; set {key} in the configuration"
        ) from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise StartupError(
            f"{folder} is not a folder of your own; remove it, or set {key} in the configuration"
        )
    return path


def find_control() -> str:
    """The address at which a client looks for the daemon of this machine.

    $FISHD_ENDPOINT, else a daemon of this user, else the system's service. A socket that another
    user has put where that of this user would be does not hide the service.
    """
    given = os.environ.get(ENDPOINT_VARIABLE)
    if given:
        return given
    own = _private_socket("control")
    # The socket of a daemon that was killed is still there.
    if _is_there(_SERVICE) and (unix_sockets.is_deserted(own) or unix_sockets.stranger(own)):
        return f"ipc://{_SERVICE}"
    return f"ipc://{own}"


def _is_there(path: Path) -> bool:
    """Is it, as far as this user may know?"""
    try:
        path.stat()
    except PermissionError:  # of its folder
        return True
    except OSError:
        return False
    return True


def claimed(
    address: str,
    rival: str = "another fishd",
    advice: str = "end it, or give this one another control.address and telemetry.address",
) -> AbstractContextManager[None]:
    """Make sure that nobody else serves an ipc address: `unix_sockets.claimed`."""
    path = socket_path(address)
    return unix_sockets.claimed(path, address, rival, advice) if path else nullcontext()


def listen(address: str, key: str, *, group: bool = False, in_use: str = IN_USE) -> socket.socket:
    """A listening socket; an ipc address must be `claimed` before.

    key: that of the address in the configuration, which messages name
    group: let user and group of this process connect to a Unix socket, and nobody else
    in_use: what to say where somebody listens there already
    Raises `StartupError`.
    """
    server = None
    try:
        where = parse(address)
        if isinstance(where, Ipc):
            server = socket.socket(socket.AF_UNIX)
            unix_sockets.bind(server, Path(where.path), unix_sockets.GROUP_MASK if group else None)
        else:
            server = socket.socket(socket.AF_INET6 if ":" in where.host else socket.AF_INET)
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            host = "" if where.host == "*" else where.host  # "" is every address
            _once_free(partial(server.bind, (host, int(where.port))))
        # Two may have bound one port: with SO_REUSEADDR only the second to listen is told.
        _once_free(partial(server.listen, _BACKLOG))
    except (OSError, ValueError) as error:
        if server:
            server.close()
        raise StartupError(
            f"{key}: cannot listen on {address}: {_why(address, error, key, in_use)}"
        ) from None
    return server


def _once_free(take: Callable[[], None]) -> None:
    """Take an address, as soon as whoever is leaving it has gone; raises OSError."""
    given_up = time.monotonic() + unix_sockets.LEAVING
    while True:
        try:
            return take()
        except OSError as error:
            if error.errno != errno.EADDRINUSE or time.monotonic() > given_up:
                raise
        time.sleep(unix_sockets.AGAIN)


def served(address: str, server: socket.socket) -> str:
    """The address that clients connect to: with the port that was taken where 0 was asked for."""
    if socket_path(address):
        return address
    return f"{address.rpartition(':')[0].replace('*', '0.0.0.0')}:{server.getsockname()[1]}"


def _next(address: Tcp) -> str:
    """Return the same address with the next port."""
    host = f"[{address.host}]" if ":" in address.host else address.host
    return f"tcp://{host}:{int(address.port) % 65535 + 1}"


def _why(address: str, error: Exception, key: str, in_use: str) -> str:
    """Why an address cannot be bound, and what would be right."""
    if not isinstance(error, OSError):
        return str(error)
    if error.errno == errno.EADDRINUSE:
        where = parse(address)
        hint = f"; for example --set {key}={_next(where)}" if isinstance(where, Tcp) else ""
        return in_use + hint
    unknown = isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL
    if unknown and isinstance(where := parse(address), Tcp):
        return (
            f"{where.host} is no address of this machine; write tcp://127.0.0.1:{where.port}, or "
            f"tcp://0.0.0.0:{where.port} for all"
        )
    return f"{error.strerror or error}; choose another address"
