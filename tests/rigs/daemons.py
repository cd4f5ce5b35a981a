"""Fixtures of a real daemon on the simulated fish, one per test or per module."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from fishd.client import AsyncFish, Fish
from fishd.lab import session
from rigs.processes import Daemon, running
from rigs.unhurried import ANSWER_TIMEOUT_S


@pytest.fixture(autouse=True)
def unhurried_rig(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let clients wait for answers, and measurements miss ticks, where real time is not tested."""
    if not request.node.get_closest_marker("realtime"):
        for client in (Fish, AsyncFish):
            monkeypatch.setitem(client.__init__.__kwdefaults__, "timeout", ANSWER_TIMEOUT_S)
        monkeypatch.setattr(session, "MAX_LOST_FRACTION", 1.0)
        monkeypatch.setattr(session, "IDLE_LIMIT", 60.0)


@pytest.fixture
def own_daemon(tmp_path: Path) -> Iterator[Daemon]:
    """Yield a real daemon on the simulated fish, at rest, for a test that ends it."""
    with running(tmp_path) as daemon:
        yield daemon


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Daemon]:
    """Yield a daemon that takes itself for a service, with the file fishd.yaml in `tmp_path`."""
    path, file = str(tmp_path / "notify"), tmp_path / "fishd.yaml"
    file.write_text("name: pike\n")
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(path)
        with running(tmp_path, "--config", str(file)) as daemon:
            yield daemon


@pytest.fixture(scope="module")
def shared_daemon(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Daemon]:
    """Yield the daemon of a module, started with the arguments in its `DAEMON`."""
    arguments = getattr(request.module, "DAEMON", ())
    with running(tmp_path_factory.mktemp("daemon"), *arguments) as module_daemon:
        yield module_daemon


@pytest.fixture
def daemon(shared_daemon: Daemon) -> Daemon:
    """Return the daemon of a module, at rest after any previous test."""
    return shared_daemon.at_rest()
