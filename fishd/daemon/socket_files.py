"""Watch over the files of fishd's sockets, which are created again when they are gone.

A logout removes the folder of the login session, and with it all sockets in it; so may a program
that cleans /tmp, or a person. Existing connections go on, but no client can connect any more.
"""

import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.core import addresses
from fishd.core.errors import StartupError
from fishd.core.process import unix_sockets
from fishd.core.signals import Level, Reason
from fishd.daemon.direct_sockets import DirectSocket
from fishd.daemon.gateway.gateways import Gateway, Gateways

CHECK_PERIOD_S = 0.5
"""Time between two checks whether the files exist [s]."""


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
        self._claimed = {gateway.address}
        self._identity = _identify(gateway.address)
        path = addresses.socket_path(gateway.address)
        self._folder = path.parent.stat() if path else None

    @property
    def is_there(self) -> bool:
        """Whether clients can find the socket where it was created."""
        return self._folder is None or self._identity == _identify(self._gateway.address) != ()

    @property
    def is_away(self) -> bool:
        """Whether the folder of the login session was gone, and the socket is in another one."""
        return not self._configured and self._gateway.address != addresses.default_address()

    def restore(self, claims: ExitStack) -> None:
        """Create the file again, in the folder where clients now look for it.

        claims: holds the claims of further addresses, and removes their files at its end
        Raise `StartupError` or OSError.
        """
        address = self._configured or addresses.control_address()
        path, former = addresses.socket_path(address), addresses.socket_path(self._gateway.address)
        assert path
        assert former
        if self._configured:
            self._restore_folder(path.parent)
        if address not in self._claimed:
            claims.enter_context(addresses.claim_address(address))
            self._claimed.add(address)
        elif path.exists() and not (path.is_socket() and unix_sockets.is_deserted(path)):
            raise StartupError(f"another program has put something else at {path}; remove that")
        with addresses.listen(address, self._key, group=self._group) as listener:
            self._gateway.listen_at(address, listener)
        self._identity = _identify(address)
        if former != path:
            former.unlink(missing_ok=True)

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
        open_direct: Callable[[Path], DirectSocket | None],
    ) -> None:
        """
        configured: `control.address`
        open_direct: function that opens fishd's own socket at a path
        """
        self._loop = loop
        self._control = gateways.control
        self._files = [
            SocketFile(gateways.control, configured, "control.address", group=True),
            SocketFile(
                gateways.telemetry, gateways.telemetry.address, "telemetry.address", group=False
            ),
        ]
        self._open_direct = open_direct
        self._claims = ExitStack()
        self._claims.callback(self._close_direct_file)
        self._direct: DirectSocket | None = None
        self._direct_file: Path | None = None
        self._direct_identity: tuple[int, ...] = ()
        self._problem = ""
        self.restored = 0
        """Number of times that files were created again since start."""
        self._open_direct_file()

    @property
    def control(self) -> str:
        """Address of the control socket; empty while its file cannot be created."""
        return self._control.address if self._files[0].is_there else ""

    @property
    def limitation(self) -> str:
        """Line about files that are gone or in another folder; empty if there are none."""
        if self._problem:
            return self._problem
        if self._files[0].is_away:
            return (
                f"the folder of {addresses.default_address()} is gone, as after a logout: the "
                f"control socket is {self._control.address}"
            )
        return ""

    def close(self) -> None:
        """Remove the files that this object has created; may be called twice."""
        self._claims.close()

    def check(self) -> None:
        """Create files that are gone, and report that; let the fish rest if that fails."""
        missing = [file for file in self._files if not file.is_there]
        direct_missing = self._direct_identity != _identify(f"ipc://{self._direct_file}")
        if not missing and not direct_missing:
            self._problem = ""
            if self._files[0].is_away:
                self._return_home()
            return
        try:
            for file in missing:
                file.restore(self._claims)
        except (OSError, StartupError) as error:
            self._report_failure(str(error))
            self._let_fish_rest()
            return
        self._finish()
        self._problem = ""
        self.restored += 1
        self._report("were gone and have been created again", "warning")

    def _return_home(self) -> None:
        """Move the control socket to the folder of the login session, if that exists again."""
        before = self._control.address
        try:
            self._files[0].restore(self._claims)
        except (OSError, StartupError):
            return  # such as another fishd that has started there since
        if self._control.address != before:
            self._finish()
            self._report("are in the folder of the login session again", "info")

    def _finish(self) -> None:
        self._open_direct_file()
        if path := addresses.socket_path(self._control.address):
            self._loop.robot.write_recipes(path)

    def _open_direct_file(self) -> None:
        self._close_direct_file()
        self._direct_file = addresses.estop_path(self._control.address)
        if self._direct_file:
            self._direct = self._open_direct(self._direct_file)
            self._direct_identity = _identify(f"ipc://{self._direct_file}")

    def _close_direct_file(self) -> None:
        if self._direct and self._direct_file:
            self._direct.close()
            if self._direct_identity == _identify(f"ipc://{self._direct_file}"):
                self._direct_file.unlink(missing_ok=True)
        self._direct = None

    def _report(self, what: str, level: Level) -> None:
        address = self._control.address
        message = f"the files of fishd's sockets {what}; control {address}"
        self._loop.reporter.event("sockets", message, level, control=address)

    def _report_failure(self, why: str) -> None:
        problem = (
            f"the files of fishd's sockets are gone and cannot be created: {why}; only 'fishctl "
            "estop', 'stop' and 'status' of this user reach this fishd"
        )
        if problem != self._problem:
            self._problem = problem
            self._loop.reporter.event("sockets", problem, "error", control="")

    def _let_fish_rest(self) -> None:
        """Let a fish fade to neutral that no live client drives, and that none can reach."""
        loop = self._loop
        if loop.lease.active or not (loop.supervisor.mode is Mode.RUNNING or loop.has_pending):
            return
        loop.stop()
        message = "no client can connect to this fishd, and no experiment holds the fish"
        loop.lease.expired = Reason("unreachable", message, "restart fishd, or log in again")
        loop.reporter.event("sockets", f"{message}: it fades to neutral", "warning", control="")


def _identify(address: str) -> tuple[int, ...]:
    """Return numbers that tell the file of an address from any later one; empty without a file."""
    path = addresses.socket_path(address)
    try:
        status = path.lstat() if path else None
    except OSError:
        return ()
    return (status.st_dev, status.st_ino, status.st_ctime_ns) if status else ()
