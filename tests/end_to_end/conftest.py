from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Daemon, running


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    """A real daemon on the simulated fish, at rest."""
    with running(tmp_path) as found:
        yield found
