"""Watch over the files of fishd's sockets: files that are gone, and modes that were changed.

A logout removes the folder of the login session, and with it all sockets in it; so may a program
that cleans /tmp, or a person. Existing connections go on, but no client can connect any more. A
mode that was changed keeps clients out, or lets other users replace the sockets.
"""

import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.core import addresses
from fishd.core.signals import Level, Reason
from fishd.core.socket_file import CREATED, SocketFile, identify
from fishd.daemon.direct_sockets import DirectSocket
from fishd.daemon.gateway.gateways import Gateways

log = logging.getLogger(__name__)


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
    def limitation(self) -> str | None:
        """Line about files that are gone or in another folder; None if there are none."""
        if problem := self._problem:
            return problem
        if self._control.is_away:
            return (
                f"the folder of {addresses.default_address()} is gone, as after a logout: the "
                f"control socket is {self._gateways.control.address}"
            )
        return None

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
        restored = [file.restore() for file in (self._control, self._telemetry)]
        if not self._control.problem and (restored[0] or self._is_direct_file_missing()):
            restored.append(CREATED if self._open_direct_file() else "")
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

    def _return_home(self) -> None:
        """Move the control socket to the folder of the login session, if that exists again."""
        if self._control.return_home():
            self._open_direct_file()
            if path := addresses.socket_path(self._gateways.control.address):
                self._loop.robot.write_recipes(path)
            self._report("are in the folder of the login session again", "info")

    def _is_direct_file_missing(self) -> bool:
        return self._direct_file is not None and (
            self._direct is None or self._direct_identity != identify(self._direct_file)
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
        self._direct_identity, self._direct_error = identify(path), ""
        return True

    def _close_direct_file(self) -> None:
        if self._direct and self._direct_file:
            self._direct.close()
            if self._direct_identity == identify(self._direct_file):
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
