from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.processes import Daemon, running


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    """A real daemon on the simulated fish, at rest."""
    with running(tmp_path) as found:
        yield found


@pytest.fixture(scope="module")
def idle_daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A real daemon at rest, for tests of one module that all leave it as it is."""
    with running(tmp_path_factory.mktemp("daemon")) as found:
        yield found
