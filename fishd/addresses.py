"""Where the sockets are, for the daemon that binds them and for clients that look for it."""

import errno
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import zmq

from fishd.errors import StartupError
from fishd.lockfile import Taken, lock_path, locked
from fishd.runtime_folder import runtime_folder

ENDPOINT_VARIABLE = "FISHD_ENDPOINT"
_SERVICE = Path("/run/fishd/control")


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

    $FISHD_ENDPOINT, else a daemon of this user, else the system's service.
    """
    given = os.environ.get(ENDPOINT_VARIABLE)
    if given:
        return given
    own = f"ipc://{_private_socket('control')}"
    # The socket of a daemon that was killed is still there.
    return f"ipc://{_SERVICE}" if _SERVICE.exists() and is_deserted(own) else own


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
            stack.enter_context(locked(path, remove=True))
        except Taken as taken:
            raise StartupError(
                f"{rival} (pid {taken.pid}) already serves {address}; {advice}"
            ) from None
        except OSError as error:
            raise StartupError(
                f"{lock_path(path)}: cannot be made: {error.strerror}; "
                "choose an address in a folder that exists"
            ) from None
        if path.is_socket() and not is_deserted(address):  # of a program that locks nothing
            raise StartupError(f"another program already serves {address}; {advice}")
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
        return probe.connect_ex(str(socket_path(address))) in nobody


def bind(server: "zmq.Socket[Any]", address: str, key: str) -> None:
    """Bind a socket; raises `StartupError` that names the configuration key of its address."""
    try:
        server.bind(address)
    except zmq.ZMQError as error:
        server.close(linger=0)
        if error.errno == zmq.EADDRINUSE:
            why = "it is in use, by another fishd perhaps; stop that, or choose another address"
        elif error.errno in (errno.ENODEV, errno.EADDRNOTAVAIL) and address.startswith("tcp://"):
            host, _, port = address.removeprefix("tcp://").rpartition(":")
            why = (
                f"{host} is no address of this machine; write tcp://127.0.0.1:{port}, or "
                f"tcp://0.0.0.0:{port} for all"
            )
        else:
            why = f"{zmq.strerror(error.errno or 0)}; choose another address"
        raise StartupError(f"{key}: cannot listen on {address}: {why}") from None
