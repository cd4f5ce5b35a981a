"""Where the sockets are, for the daemon that binds them and for clients that look for it."""

import errno
import os
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from fishd.errors import StartupError
from fishd.lockfile import NotALock, Taken, lock_path, locked
from fishd.runtime_folder import runtime_folder
from fishd.socket_owner import stranger
from fishd.zmq_address import Ipc, parse

ENDPOINT_VARIABLE = "FISHD_ENDPOINT"
_SERVICE = Path("/run/fishd/control")
_LEAVING, _AGAIN = 1.0, 0.02
"""How long the gateways of a fishd that was killed may take to leave, and a pause meanwhile [s]."""
_BACKLOG = 128
"""Connections that may wait to be accepted."""


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

    $FISHD_ENDPOINT, else a daemon of this user, else the system's service. What stands where that
    of this user would be, but is a stranger's, does not hide the service.
    """
    given = os.environ.get(ENDPOINT_VARIABLE)
    if given:
        return given
    path = _private_socket("control")
    own = f"ipc://{path}"
    # The socket of a daemon that was killed is still there.
    there_is_none = _is_there(_SERVICE) and (is_deserted(own) or stranger(path))
    return f"ipc://{_SERVICE}" if there_is_none else own


def _is_there(path: Path) -> bool:
    """Is it, as far as this user may know?"""
    try:
        path.stat()
    except PermissionError:  # of its folder
        return True
    except OSError:
        return False
    return True


def _private_socket(name: str) -> Path:
    return Path(runtime_folder()) / name


@contextmanager
def claimed(
    address: str,
    rival: str = "another fishd",
    advice: str = "stop it, or give this one another control.address and telemetry.address",
) -> Iterator[None]:
    """Make sure that nobody else serves an ipc address, and take its files away at the end.

    Binding alone does not tell: ZeroMQ takes the socket file of a living process away from it, and
    leaves its own behind. Raises `StartupError`, which names the `rival` and gives the `advice`,
    when somebody is there, this process included.
    """
    if not address.startswith("ipc://"):
        yield
        return
    path = socket_path(address)
    with ExitStack() as stack:
        try:
            if path.exists() and not path.is_socket():
                raise StartupError(
                    f"{path} is there already and is no socket; choose another address"
                )
            stack.enter_context(locked(path.resolve(), remove=True))
        except Taken as taken:
            raise StartupError(
                f"{rival} (pid {taken.pid}) already serves {address}; {advice}"
            ) from None
        except NotALock as error:
            raise StartupError(
                f"{error.filename} {error.strerror}; remove it, or choose an address in a folder "
                "of your own"
            ) from None
        except OSError as error:
            raise StartupError(
                f"{lock_path(path)}: cannot be made: {error.strerror}; "
                "choose an address in a folder that exists"
            ) from None
        given_up = time.monotonic() + _LEAVING
        while path.is_socket() and not is_deserted(address):
            if time.monotonic() > given_up:  # a program that locks nothing
                raise StartupError(f"another program already serves {address}; {advice}")
            time.sleep(_AGAIN)
        try:
            yield
        finally:
            if path.is_socket():
                path.unlink()


def socket_path(address: str) -> Path:
    """The file of an ipc address."""
    return Path(address.removeprefix("ipc://"))


def is_deserted(address: str) -> bool:
    """True when it is certain, without a wait, that nobody listens at an ipc address."""
    if not address.startswith("ipc://"):
        return False
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        nobody = (errno.ENOENT, errno.ENOTDIR, errno.ECONNREFUSED)
        try:
            return probe.connect_ex(str(socket_path(address))) in nobody
        except OSError:  # no socket has a path that long
            return True


def listen(address: str, key: str, *, group: bool = False) -> socket.socket:
    """A listening socket; an ipc address must be `claimed` before, what is left there is removed.

    key: that of the address in the configuration, which messages name
    group: let user and group of this process connect to a Unix socket, and nobody else
    Raises `StartupError`.
    """
    server = None
    try:
        where = parse(address)
        if isinstance(where, Ipc):
            server = socket.socket(socket.AF_UNIX)
            _bind_path(server, where.path, 0o117 if group else None)
        else:
            family = socket.AF_INET6 if ":" in where.host else socket.AF_INET
            host = "" if where.host == "*" else where.host  # "" is every address
            server = socket.socket(family)
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            _bind_port(server, host, int(where.port))
        server.listen(_BACKLOG)
    except (OSError, ValueError) as error:
        if server:
            server.close()
        raise StartupError(f"{key}: cannot listen on {address}: {_why(address, error)}") from None
    return server


def _bind_port(server: socket.socket, host: str, port: int) -> None:
    given_up = time.monotonic() + _LEAVING
    while True:
        try:
            return server.bind((host, port))
        except OSError as error:
            if error.errno != errno.EADDRINUSE or time.monotonic() > given_up:
                raise
        time.sleep(_AGAIN)


def _bind_path(server: socket.socket, path: str, mask: int | None) -> None:
    with suppress(FileNotFoundError):
        Path(path).unlink()  # of a fishd that was killed
    before = os.umask(mask) if mask is not None else None
    try:
        server.bind(path)
    finally:
        if before is not None:
            os.umask(before)


def served(address: str, server: socket.socket) -> str:
    """The address that clients connect to: with the port that was taken where 0 was asked for."""
    if not address.startswith("tcp://"):
        return address
    host = address.removeprefix("tcp://").rpartition(":")[0].replace("*", "0.0.0.0")
    return f"tcp://{host}:{server.getsockname()[1]}"


def _why(address: str, error: Exception) -> str:
    """Why an address cannot be bound, and what would be right."""
    if not isinstance(error, OSError):
        return str(error)
    if error.errno == errno.EADDRINUSE:
        return "it is in use, by another fishd perhaps; stop that, or choose another address"
    unknown = isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL
    if unknown and address.startswith("tcp://"):
        host, _, port = address.removeprefix("tcp://").rpartition(":")
        return (
            f"{host} is no address of this machine; write tcp://127.0.0.1:{port}, or "
            f"tcp://0.0.0.0:{port} for all"
        )
    return f"{error.strerror or error}; choose another address"
