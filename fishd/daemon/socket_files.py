"""Watch over the files of fishd's sockets: files that are gone, and modes that were changed.

A logout removes the folder of the login session, and with it all sockets in it; so may a program
that cleans /tmp, or a person. Existing connections go on, but no client can connect any more. A
mode that was changed keeps clients out, or lets other users replace the sockets.
"""

import logging
import os
import stat
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.core import addresses
from fishd.core.errors import StartupError
from fishd.core.process import unix_sockets
from fishd.core.signals import Level, Reason
from fishd.daemon.direct_sockets import DirectSocket
from fishd.daemon.gateway.gateways import Gateway, Gateways

log = logging.getLogger(__name__)

_CREATED, _OPENED = "were gone and have been created again", "can be reached again"
_MODES = "or their folder had other modes, and have those of the start again"
"""What was restored, for messages about the files."""


class SocketFile:
    """File of a socket on which a gateway listens."""

    def __init__(self, gateway: Gateway, configured: str | None, key: str, group: bool) -> None:
        """
        gateway: its address may be that of a file, or another one, which cannot be removed
        configured: address by the configuration; None for one that depends on the login session
        key: key of the configuration, for messages
        group: whether only the user and the group of this process may connect
        """
        self._gateway = gateway
        self._configured = configured
        self._key, self._group = key, group
        self._home = gateway.address
        """Address at the start, which is claimed as long as fishd runs."""
        self._claim = ExitStack()
        """Claim of another address."""
        path = addresses.socket_path(gateway.address)
        self._identity = _identify(path)
        self._folder = path.parent.stat() if path else None
        self._mode = self._identity[-1] if self._identity else 0
        self.problem = ""
        """Why the file could not be created again; empty if it is there."""
        self.limitation = ""
        """Mode that fishd may not restore; empty if there is none."""

    def keep(self) -> str:
        """Restore the modes, or the file if it is gone; return what was restored, or "".

        Raise `StartupError` or OSError.
        """
        path, self.limitation = addresses.socket_path(self._gateway.address), ""
        if path is None:
            return ""
        assert self._folder
        restored = self._restore_mode(path.parent, self._folder.st_mode)
        if _identify(path)[:2] == self._identity[:2]:
            restored |= self._restore_mode(path, self._mode)
        if not self._is_there(path):
            self._create()
            return _CREATED
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
        identity = _identify(path)
        if identity != self._identity and _is_own(path):  # touched, not replaced
            self._identity = identity
        return identity == self._identity != ()

    @property
    def is_away(self) -> bool:
        """Whether the folder of the login session was gone, and the socket is in another one."""
        return not self._configured and self._gateway.address != addresses.default_address()

    def return_home(self) -> bool:
        """Move to the folder of the login session if that exists again; return whether it does."""
        before = self._gateway.address
        with suppress(OSError, StartupError):  # such as another fishd that has started there since
            self._create()
        return self._gateway.address != before

    def close(self) -> None:
        """Release the claim of another folder, and remove the file there; may be called twice."""
        self._claim.close()

    def _create(self) -> None:
        """Create the file again, in the folder where clients now look for it."""
        address = self._configured or addresses.control_address()
        path, former = addresses.socket_path(address), addresses.socket_path(self._gateway.address)
        assert path
        assert former
        if self._configured:
            self._restore_folder(path.parent)
        # Claiming an address would wait for a program that listens there.
        if path.exists() and not (path.is_socket() and unix_sockets.is_deserted(path)):
            raise StartupError(f"another program has put something else at {path}; remove that")
        with ExitStack() as claim:
            if address not in (self._home, self._gateway.address):
                claim.enter_context(addresses.claim_address(address))
            with addresses.listen(address, self._key, group=self._group) as listener:
                self._gateway.listen_at(address, listener)
            if former != path:
                self._claim.close()
                self._claim = claim.pop_all()
        self._identity = _identify(path)
        self._mode = self._identity[-1] if self._identity else 0
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


class SocketWatch:
    """Watch over all files of fishd's sockets; `check` is called between ticks."""

    def __init__(
        self,
        loop: ControlLoop,
        gateways: Gateways,
        configured: str | None,
        open_direct: Callable[[Path], DirectSocket],
    ) -> None:
        """
        configured: `control.address`
        open_direct: function that opens fishd's own socket at a path, or raises OSError or
            ValueError
        """
        self._loop = loop
        self._gateways = gateways
        self._control = SocketFile(gateways.control, configured, "control.address", group=True)
        telemetry = gateways.telemetry
        self._telemetry = SocketFile(telemetry, telemetry.address, "telemetry.address", group=False)
        self._open_direct = open_direct
        self._direct: DirectSocket | None = None
        self._direct_file: Path | None = None
        self._direct_identity: tuple[int, ...] = ()
        self._direct_error = ""
        self._reported = ""
        """Problem that was reported last."""
        self.restored = 0
        """Number of times that files were created again since start."""
        self._open_direct_file()

    @property
    def control(self) -> str:
        """Address of the control socket; empty while its file cannot be created."""
        return "" if self._control.problem else self._gateways.control.address

    @property
    def limitation(self) -> str:
        """Line about files that are gone or in another folder; empty if there are none."""
        if problem := self._problem:
            return problem
        if self._control.is_away:
            return (
                f"the folder of {addresses.default_address()} is gone, as after a logout: the "
                f"control socket is {self._gateways.control.address}"
            )
        return ""

    @property
    def _problem(self) -> str:
        if why := self._control.problem:
            return (
                f"clients cannot reach the control socket, which cannot be created again: {why}; "
                "only 'fishctl estop', 'stop' and 'status' of this user reach this fishd"
            )
        if why := self._telemetry.problem:
            return f"clients cannot reach telemetry, whose socket cannot be created again: {why}"
        return self._control.limitation or self._telemetry.limitation

    def close(self) -> None:
        """Remove the files that this object has created; may be called twice."""
        self._close_direct_file()
        self._control.close()
        self._telemetry.close()

    def check(self) -> None:
        """Restore files and modes, and report that; let the fish rest if that fails twice."""
        was_missing = bool(self._control.problem)
        restored = [self._restore(file) for file in (self._control, self._telemetry)]
        if not self._control.problem and (restored[0] or self._is_direct_file_missing()):
            restored.append(_CREATED if self._open_direct_file() else "")
            if path := addresses.socket_path(self._gateways.control.address):
                self._loop.robot.write_recipes(path)
        if any(restored):
            self.restored += 1
            self._report(next(filter(None, restored)), "warning")
        if self._problem != self._reported:
            self._reported = self._problem
            if self._problem:
                self._loop.reporter.event("sockets", self._problem, "error", control=self.control)
        if self._control.problem:
            if was_missing and not self._gateways.keyed_control:
                self._let_fish_rest()
        elif self._control.is_away and not any(restored):
            self._return_home()

    def _restore(self, file: SocketFile) -> str:
        """Restore a file and its modes; return what was restored, or ""."""
        before, file.problem = file.problem, ""
        try:
            return file.keep() or (_OPENED if before else "")
        except (OSError, StartupError) as error:
            file.problem = file.limitation or str(error)
            return ""

    def _return_home(self) -> None:
        """Move the control socket to the folder of the login session, if that exists again."""
        if self._control.return_home():
            self._open_direct_file()
            if path := addresses.socket_path(self._gateways.control.address):
                self._loop.robot.write_recipes(path)
            self._report("are in the folder of the login session again", "info")

    def _is_direct_file_missing(self) -> bool:
        return self._direct_file is not None and (
            self._direct is None or self._direct_identity != _identify(self._direct_file)
        )

    def _open_direct_file(self) -> bool:
        """Open fishd's own socket beside the control socket; return whether there is one now."""
        self._close_direct_file()
        self._direct_file = path = addresses.estop_path(self._gateways.control.address)
        if path is None:
            return False
        try:
            self._direct = self._open_direct(path)
        except (OSError, ValueError) as error:
            if self._direct_error != str(error):
                self._direct_error = str(error)
                log.warning(
                    "%s: not available, so an emergency stop needs the control socket: %s",
                    path,
                    error,
                )
            return False
        self._direct_identity, self._direct_error = _identify(path), ""
        return True

    def _close_direct_file(self) -> None:
        if self._direct and self._direct_file:
            self._direct.close()
            if self._direct_identity == _identify(self._direct_file):
                with suppress(OSError):
                    self._direct_file.unlink()
        self._direct = None

    def _report(self, what: str, level: Level) -> None:
        where = f"; control {self.control}" if self.control else ""
        message = f"the files of fishd's sockets {what}{where}"
        self._loop.reporter.event("sockets", message, level, control=self.control)

    def _let_fish_rest(self) -> None:
        """Let a fish fade to neutral that no live client drives, and that none can reach."""
        loop = self._loop
        if loop.lease.active or not (loop.supervisor.mode is Mode.RUNNING or loop.pending):
            return
        loop.stop()
        message = "no client can connect to this fishd, and no experiment holds the fish"
        loop.lease.expired = Reason("unreachable", message, "restart fishd, or log in again")
        loop.reporter.event("sockets", f"{message}: it fades to neutral", "warning", control="")


def _is_own(path: Path) -> bool:
    """Return whether this process listens at a path."""
    with suppress(PermissionError):
        listener = unix_sockets.find_listener(path)
        return listener is not None and listener.pid == os.getpid()
    return False


def _identify(path: Path | None) -> tuple[int, ...]:
    """Return numbers that tell a file from one that replaces it; empty without a file."""
    try:
        status = path.lstat() if path else None
    except OSError:
        return ()
    return (status.st_dev, status.st_ino, status.st_mtime_ns, status.st_mode) if status else ()
