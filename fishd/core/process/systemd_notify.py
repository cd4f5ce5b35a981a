"""Notifications to systemd that fishd is ready, still ticks, or stops.

The protocol of sd_notify(3): datagrams to the socket that $NOTIFY_SOCKET names. Without systemd,
nothing is sent.
"""

import os
import socket
from contextlib import suppress

_FEEDS_PER_LIMIT = 8
"""Number of watchdog notifications in the time that systemd allows."""


class SystemdNotifier:
    """Sender that never blocks; a message that cannot be sent is sent again with the next tick."""

    def __init__(self) -> None:
        path = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._feed_period = _read_watchdog_limit() / _FEEDS_PER_LIMIT
        self._next_feed = 0.0
        self._ready = False

    @property
    def is_service(self) -> bool:
        """Whether systemd has started this process and takes its messages."""
        if not self._address:
            return False
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe, suppress(OSError):
            probe.connect(self._address)
            return True
        return False

    def ticked(self, now: float) -> None:
        """Feed the watchdog, and report readiness with the first tick; call it only from the tick.

        In virtual time, call it also while a tick is awaited, when nothing moves.

        now: start of the tick [s, monotonic]
        """
        if now < self._next_feed or not self._address:
            return
        if self._send("WATCHDOG=1" if self._ready else "READY=1\nWATCHDOG=1"):
            self._ready = True
            self._next_feed = now + self._feed_period

    def status(self, line: str) -> None:
        """Set the line that `systemctl status` shows."""
        self._send(f"STATUS={line}")

    def stopping(self) -> None:
        """Report that the daemon stops."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Close the socket; may be called twice."""
        self._socket.close()

    def _send(self, state: str) -> bool:
        """Send a message; return whether systemd received it."""
        if not self._address:
            return False
        try:
            self._socket.sendto(state.encode(), self._address)
        except OSError:
            return False
        return True


def _read_watchdog_limit() -> float:
    """Return the longest silence that systemd allows, infinite without a watchdog [s]."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return float("inf")
    microseconds = os.environ.get("WATCHDOG_USEC", "")
    return int(microseconds) * 1e-6 if microseconds.isdigit() else float("inf")
