"""Addresses of sockets: their syntax, where fishd's sockets are, and how to listen there.

ZeroMQ takes more than fishd does, such as `tcp://SOURCE;HOST:PORT` and names of network
interfaces. fishd accepts only addresses that ZeroMQ reads as a reader of the configuration does.
"""

import errno
import ipaddress
import os
import re
import socket
import stat
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

from fishd.core.errors import StartupError
from fishd.core.process import unix_sockets
from fishd.core.process.runtime_folder import runtime_folder

ADDRESS_FORM = "tcp://HOST:PORT or ipc://PATH is needed"
ENDPOINT_VARIABLE = "FISHD_ENDPOINT"
KEYS_VARIABLE = "FISHD_KEYS"
ADDRESS_IN_USE = "it is in use, by another fishd perhaps; end that, or choose another address"
SERVICE_SOCKET = Path("/run/fishd/control")
_MAX_PENDING_CONNECTIONS = 128
"""Maximum number of connections that wait to be accepted."""

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
    """Return the parts of an address; host and port may be `*`. Raise ValueError if invalid."""
    tcp, ipc = _TCP.fullmatch(text), _IPC.fullmatch(text)
    if ipc:
        unix_sockets.check_length(ipc["path"])
        return Ipc(ipc["path"])
    if not tcp:
        raise ValueError(ADDRESS_FORM)
    host, port = tcp["host"], tcp["port"]
    if port != "*" and (len(port) > 5 or int(port) > 65535):
        raise ValueError(f"{ADDRESS_FORM}; {port} is not a port, 65535 is the highest")
    if host.startswith("["):
        host = host[1:-1]
        if _parse_ip(host.partition("%")[0]) is None:
            raise ValueError(f"{ADDRESS_FORM}; '[{host}]' is not an IPv6 address")
    elif host != "*" and (
        not _NAME.fullmatch(host) or (_DIGITS.fullmatch(host) and _parse_ip(host) is None)
    ):
        raise ValueError(f"{ADDRESS_FORM}; '{host}' is not a host")
    return Tcp(host, port)


def _parse_ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def is_ipv6(text: str) -> bool:
    """Return whether a socket needs the IPv6 option, with which it resolves names to IPv6, too."""
    return "[" in text


def is_local(text: str) -> bool:
    """Return whether it is certain that only this machine can reach an address."""
    address = parse(text)
    if isinstance(address, Ipc) or address.host == "localhost":
        return True
    number = _parse_ip(address.host)
    return number is not None and number.version == 4 and number.is_loopback


def find_listen_problem(text: str) -> str | None:
    """Return why fishd cannot listen on an address; None if it can. Port 0 means any free port."""
    try:
        address = parse(text)
    except ValueError as error:
        return str(error)
    return ADDRESS_FORM if isinstance(address, Tcp) and address.port == "*" else None


def find_connect_problem(text: str) -> str | None:
    """Return why no client can connect to this address; None if one can."""
    try:
        address = parse(text)
    except ValueError as error:
        return str(error)
    if isinstance(address, Ipc):
        return None
    if address.host == "*":
        return f"{ADDRESS_FORM}; * is what an agent binds, here give the host that it runs on"
    if address.port == "*" or int(address.port) == 0:
        return (
            f"{ADDRESS_FORM}; {address.port} is what an agent binds, here give the port that it "
            "was given"
        )
    return None


def socket_path(address: str) -> Path | None:
    """Return the file of an ipc address; None for any other address."""
    path = address.removeprefix("ipc://")
    return Path(path) if path != address else None


def estop_path(control: str) -> Path | None:
    """Return the socket for an emergency stop; None if `control` is not a Unix socket."""
    path = socket_path(control)
    return path.with_name(f"{path.name}.estop") if path else None


def default_address() -> str:
    """Return the default address of a daemon of this user; its folder may not exist."""
    return f"ipc://{_private_socket('control')}"


def control_address() -> str:
    """Return the default address of a daemon; create its folder if that belongs to fishd.

    Raise `StartupError` if the folder may belong to another user.
    """
    return f"ipc://{_ensure_private_folder(_private_socket('control'), 'control.address')}"


def virtual_pi_socket(configured: str | None) -> Path:
    """Return the socket of the virtual Pi; create the default folder, as `control_address` does."""
    if configured is not None:
        return Path(configured)
    return _ensure_private_folder(_private_socket("virtual-pi"), "virtual_pi.socket")


def _private_socket(name: str) -> Path:
    return Path(runtime_folder()) / name


def _ensure_private_folder(path: Path, key: str) -> Path:
    """Return the path of a socket after making sure that this user owns its folder."""
    folder = path.parent
    try:
        with suppress(FileExistsError):  # raised for a file, which is found below
            folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.stat(follow_symlinks=False)
    except OSError as error:
        raise StartupError(
            f"{folder} cannot be created: {error.strerror}; set {key} in the configuration"
        ) from None
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        raise StartupError(
            f"{folder} is not a folder that you own; remove it, or set {key} in the configuration"
        )
    return path


def find_control_address() -> str:
    """Return the address at which a client looks for the daemon of this machine.

    $FISHD_ENDPOINT, else a daemon of this user, else the system's service. A socket that another
    user has created in the place of this user's does not hide the service.
    """
    endpoint = os.environ.get(ENDPOINT_VARIABLE)
    if endpoint:
        return endpoint
    own = _private_socket("control")
    # A daemon that was killed leaves its socket behind.
    if _may_exist(SERVICE_SOCKET) and (
        unix_sockets.is_deserted(own) or unix_sockets.find_trust_problem(own)
    ):
        return f"ipc://{SERVICE_SOCKET}"
    return f"ipc://{own}"


def is_default_address(address: str) -> bool:
    """Return whether clients find a fishd at this address without being given one."""
    return address in (f"ipc://{SERVICE_SOCKET}", f"ipc://{_private_socket('control')}")


def _may_exist(path: Path) -> bool:
    """Return whether a path exists, as far as this user can see."""
    try:
        path.stat()
    except PermissionError:  # for its folder
        return True
    except OSError:
        return False
    return True


def claim_address(
    address: str,
    rival: str = "another fishd",
    advice: str = "end it, or give this one another control.address and telemetry.address",
) -> AbstractContextManager[None]:
    """Make sure that no other process serves an ipc address: `unix_sockets.claim_socket`."""
    path = socket_path(address)
    return unix_sockets.claim_socket(path, address, rival, advice) if path else nullcontext()


def listen(
    address: str, key: str, *, group: bool = False, in_use: str = ADDRESS_IN_USE
) -> socket.socket:
    """Return a listening socket; call `claim_address` for an ipc address first.

    key: key of the address in the configuration, for messages
    group: only the user and the group of this process may connect to a Unix socket
    in_use: message for an address on which another program listens
    Raise `StartupError`.
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
            _retry_while_in_use(partial(server.bind, (host, int(where.port))))
        # SO_REUSEADDR lets two processes bind one port; the second one to listen gets the error.
        _retry_while_in_use(partial(server.listen, _MAX_PENDING_CONNECTIONS))
    except (OSError, ValueError) as error:
        if server:
            server.close()
        raise StartupError(
            f"{key}: cannot listen on {address}: {_explain_bind_error(address, error, key, in_use)}"
        ) from None
    return server


def _retry_while_in_use(take: Callable[[], None]) -> None:
    """Call `take`, and retry while the address is in use by a process that ends; raise OSError."""
    deadline = time.monotonic() + unix_sockets.RELEASE_TIMEOUT_S
    while True:
        try:
            return take()
        except OSError as error:
            if error.errno != errno.EADDRINUSE or time.monotonic() > deadline:
                raise
        time.sleep(unix_sockets.RETRY_INTERVAL_S)


def reachable_address(address: str, server: socket.socket) -> str:
    """Return the address that clients connect to, with the actual port in place of port 0."""
    if socket_path(address):
        return address
    return f"{address.rpartition(':')[0].replace('*', '0.0.0.0')}:{server.getsockname()[1]}"


def _with_next_port(address: Tcp) -> str:
    """Return the same address with the next port."""
    host = f"[{address.host}]" if ":" in address.host else address.host
    return f"tcp://{host}:{int(address.port) % 65535 + 1}"


def _explain_bind_error(address: str, error: Exception, key: str, in_use: str) -> str:
    """Return why an address cannot be bound, and what would be right."""
    if not isinstance(error, OSError):
        return str(error)
    if error.errno == errno.EADDRINUSE:
        where = parse(address)
        hint = (
            f"; for example --set {key}={_with_next_port(where)}" if isinstance(where, Tcp) else ""
        )
        return in_use + hint
    unknown = isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL
    if unknown and isinstance(where := parse(address), Tcp):
        return (
            f"{where.host} is not an address of this machine; write tcp://127.0.0.1:{where.port}, "
            f"or tcp://0.0.0.0:{where.port} for all"
        )
    return f"{error.strerror or error}; choose another address"
