"""Messages to systemd: ready with the first tick, the watchdog from ticks only, stopping."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from fishd.core.process.systemd_notify import SystemdNotifier


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        listener.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        monkeypatch.setenv("WATCHDOG_USEC", "2000000")
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
        yield listener


def read_messages(listener: socket.socket) -> list[str]:
    """Return all messages that have arrived."""
    messages = []
    while True:
        try:
            messages.append(listener.recv(4096).decode())
        except BlockingIOError:
            return messages


def test_the_first_tick_says_ready_and_later_ones_feed_the_watchdog(systemd: socket.socket) -> None:
    notifier = SystemdNotifier()
    for index in range(41):
        notifier.ticked(index * 0.05)
    messages = read_messages(systemd)
    assert messages[0] == "READY=1\nWATCHDOG=1"
    assert set(messages[1:]) == {"WATCHDOG=1"}
    assert 6 <= len(messages) <= 10  # several times in the two seconds that systemd waits
    notifier.close()


def test_without_ticks_the_watchdog_gets_nothing(systemd: socket.socket) -> None:
    notifier = SystemdNotifier()
    notifier.status("swimming")
    notifier.stopping()
    assert read_messages(systemd) == ["STATUS=swimming", "STOPPING=1"]
    notifier.close()


def test_others_watchdog_is_unfed(systemd: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_PID", "1")
    notifier = SystemdNotifier()
    for index in range(1, 100):
        notifier.ticked(index * 0.05)
    assert read_messages(systemd) == ["READY=1\nWATCHDOG=1"]
    notifier.close()


def test_a_deaf_systemd_stops_nothing(
    systemd: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    notifier = SystemdNotifier()
    systemd.close()
    notifier.ticked(1.0)
    monkeypatch.delenv("NOTIFY_SOCKET")
    silent = SystemdNotifier()
    silent.ticked(1.0)
    for closed_twice in (notifier, silent):
        closed_twice.close()
        closed_twice.close()
