"""Where the sockets are, for the daemon that binds them and for clients that look for it."""

import fcntl
import os
import stat
from pathlib import Path
from typing import IO, Any

import zmq

from fishd.errors import StartupError

ENDPOINT_VARIABLE = "FISHD_ENDPOINT"
_SERVICE = Path("/run/fishd/control")


def control_address() -> str:
    """The default address for a daemon; makes its folder where that is fishd's own business.

    Raises `StartupError` when the folder could be somebody else's trap.
    """
    path = _private_socket()
    folder = path.parent
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.stat(follow_symlinks=False)
    except OSError as error:
        raise StartupError(
            f"{folder}: cannot be made: {error.strerror}; set control.address in the configuration"
        ) from None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise StartupError(
            f"{folder} is not a folder of your own; remove it, or set control.address in the "
            "configuration"
        )
    return f"ipc://{path}"


def find_control() -> str:
    """The address at which a client looks for the daemon of this machine.

    $FISHD_ENDPOINT, else a daemon of this user, else the system's service.
    """
    given = os.environ.get(ENDPOINT_VARIABLE)
    if given:
        return given
    own = _private_socket()
    return f"ipc://{_SERVICE if _SERVICE.exists() and not own.exists() else own}"


def _private_socket() -> Path:
    """systemd's folder, else the login session's, else one under /tmp."""
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    if runtime:
        return Path(runtime) / "control"
    session = os.environ.get("XDG_RUNTIME_DIR")
    if session and Path(session).is_dir():
        return Path(session) / "fishd" / "control"
    return Path(f"/tmp/fishd-{os.getuid()}/control")


def claim(address: str) -> IO[str] | None:
    """Make sure that no other daemon serves an ipc address; keep what is returned until the end.

    Binding alone does not tell: ZeroMQ takes the socket file of a living daemon away from it.
    Raises `StartupError` when another daemon is there.
    """
    if not address.startswith("ipc://"):
        return None
    lock_path = Path(address.removeprefix("ipc://") + ".lock")
    try:
        lock = lock_path.open("a+", encoding="ascii")
    except OSError as error:
        raise StartupError(
            f"{lock_path}: cannot be made: {error.strerror}; "
            "set control.address to a path in a folder that exists"
        ) from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.seek(0)
        pid = lock.read().strip() or "unknown"
        lock.close()
        raise StartupError(
            f"another fishd (pid {pid}) already serves {address}; stop it, or give this one "
            "another control.address and telemetry.address"
        ) from None
    lock.truncate(0)
    lock.write(f"{os.getpid()}\n")
    lock.flush()
    return lock


def bind(socket: "zmq.Socket[Any]", address: str, key: str) -> None:
    """Bind a socket; raises `StartupError` that names the configuration key of its address."""
    try:
        socket.bind(address)
    except zmq.ZMQError as error:
        socket.close(linger=0)
        if error.errno == zmq.EADDRINUSE:
            why = "it is in use, by another fishd perhaps; stop that, or choose another address"
        else:
            why = f"{zmq.strerror(error.errno or 0)}; choose another address"
        raise StartupError(f"{key}: cannot listen on {address}: {why}") from None
