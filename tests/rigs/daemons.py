"""Fixtures: a real daemon on the simulated fish, one per test or one for all of a module."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fishd.lab import session
from rigs.processes import Daemon, running


@pytest.fixture(autouse=True)
def unhurried_rig(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """A measurement may miss any of its ticks where real time is not judged."""
    if not request.node.get_closest_marker("realtime"):
        monkeypatch.setattr(session, "MAX_LOST_FRACTION", 1.0)
        monkeypatch.setattr(session, "IDLE_LIMIT", 60.0)


@pytest.fixture
def own_daemon(tmp_path: Path) -> Iterator[Daemon]:
    """A real daemon on the simulated fish, at rest, for a test that ends it."""
    with running(tmp_path) as found:
        yield found


@pytest.fixture(scope="module")
def shared_daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with running(tmp_path_factory.mktemp("daemon")) as found:
        yield found


@pytest.fixture
def daemon(shared_daemon: Daemon) -> Daemon:
    """One for all tests of a module, at rest whatever the test before has done with it."""
    return shared_daemon.at_rest()
