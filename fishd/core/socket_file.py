"""File of a Unix socket, which is created again when it is gone or has another mode."""

import os
import socket
import stat
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Protocol

from fishd.core import addresses
from fishd.core.errors import StartupError
from fishd.core.process import unix_sockets

CREATED, _OPENED = "were gone and have been created again", "can be reached again"
_MODES = "or their folder had other modes, and have those of the start again"
"""What was restored, for messages about the files."""


class Server(Protocol):
    """Server of a socket, which can be given another listener."""

    address: str

    def listen_at(self, address: str, listener: socket.socket) -> None:
        """Listen there, too, or from now on; raise OSError."""


class SocketFile:
    """File of a socket on which a server listens."""

    def __init__(self, server: Server, configured: str | None, key: str, group: bool) -> None:
        """
        server: its address may be that of a file, or another one, which cannot be removed
        configured: address by the configuration; None for one that depends on the login session
        key: key of the configuration, for messages
        group: whether only the user and the group of this process may connect
        """
        self._server = server
        self._configured = configured
        self._key, self._group = key, group
        self._home = server.address
        """Address at the start, which is claimed as long as fishd runs."""
        self._claim = ExitStack()
        """Claim of another address."""
        path = addresses.socket_path(server.address)
        self._identity = identify(path)
        self._folder = path.parent.stat() if path else None
        self._mode = self._identity[-1] if self._identity else 0
        self.problem = ""
        """Why the file could not be created again; empty if it is there."""
        self.limitation = ""
        """Mode that fishd may not restore; empty if there is none."""

    def restore(self) -> str:
        """Restore the modes, or the file if it is gone; return what was restored, or ""."""
        before, self.problem = self.problem, ""
        try:
            return self._restore() or (_OPENED if before else "")
        except (OSError, StartupError) as error:
            self.problem = self.limitation or str(error)
            return ""

    def _restore(self) -> str:
        """Do as `restore`; raise `StartupError` or OSError."""
        path, self.limitation = addresses.socket_path(self._server.address), ""
        if path is None:
            return ""
        assert self._folder
        restored = self._restore_mode(path.parent, self._folder.st_mode)
        if identify(path)[:2] == self._identity[:2]:
            restored |= self._restore_mode(path, self._mode)
        if not self._is_there(path):
            self._create()
            return CREATED
        return _MODES if restored else ""

    def _restore_mode(self, path: Path, start_mode: int) -> bool:
        """Give a file of this user its mode of the start; return whether it had another one."""
        try:
            status = path.stat()
        except OSError:
            return False
        is_other_kind = stat.S_IFMT(status.st_mode) != stat.S_IFMT(start_mode)
        if is_other_kind or status.st_mode == start_mode:
            return False
        mode = stat.S_IMODE(start_mode)
        if status.st_uid != os.geteuid():
            self.limitation = (
                f"{path} belongs to another user, and its mode was changed from {mode:o} to "
                f"{stat.S_IMODE(status.st_mode):o}: sudo chmod {mode:o} {path}"
            )
            return False
        path.chmod(mode)
        return True

    def _is_there(self, path: Path) -> bool:
        """Return whether clients can find the socket where it was created."""
        identity = identify(path)
        if identity != self._identity and _is_own(path):  # touched, not replaced
            self._identity = identity
        return identity == self._identity != ()

    @property
    def is_away(self) -> bool:
        """Whether the folder of the login session was gone, and the socket is in another one."""
        return not self._configured and self._server.address != addresses.default_address()

    def return_home(self) -> bool:
        """Move to the folder of the login session if that exists again; return whether it does."""
        before = self._server.address
        with suppress(OSError, StartupError):  # such as another fishd that has started there since
            self._create()
        return self._server.address != before

    def close(self) -> None:
        """Release the claim of another folder, and remove the file there; may be called twice."""
        self._claim.close()

    def _create(self) -> None:
        """Create the file again, in the folder where clients now look for it."""
        address = self._configured or addresses.control_address()
        path, former = addresses.socket_path(address), addresses.socket_path(self._server.address)
        assert path
        assert former
        if self._configured:
            self._restore_folder(path.parent)
        # Claiming an address would wait for a program that listens there.
        if path.exists() and not (path.is_socket() and unix_sockets.is_deserted(path)):
            raise StartupError(f"another program has put something else at {path}; remove that")
        with ExitStack() as claim:
            if address not in (self._home, self._server.address):
                claim.enter_context(addresses.claim_address(address))
            with addresses.listen(address, self._key, group=self._group) as listener:
                self._server.listen_at(address, listener)
            if former != path:
                self._claim.close()
                self._claim = claim.pop_all()
        self._identity = identify(path)
        if former != path:
            self._folder = path.parent.stat()
            with suppress(OSError):
                former.unlink()

    def _restore_folder(self, folder: Path) -> None:
        """Create a configured folder as it was; raise `StartupError` for another user's folder."""
        assert self._folder
        if not folder.exists():
            folder.mkdir()
            folder.chmod(self._folder.st_mode & 0o7777)
        if folder.stat().st_uid not in (self._folder.st_uid, os.geteuid()):
            raise StartupError(f"{folder} belongs to another user now; remove it")


def _is_own(path: Path) -> bool:
    """Return whether this process listens at a path."""
    with suppress(PermissionError):
        listener = unix_sockets.find_listener(path)
        return listener is not None and listener.pid == os.getpid()
    return False


def identify(path: Path | None) -> tuple[int, ...]:
    """Return numbers that tell a file from one that replaces it; empty without a file."""
    try:
        status = path.lstat() if path else None
    except OSError:
        return ()
    return (status.st_dev, status.st_ino, status.st_mtime_ns, status.st_mode) if status else ()
