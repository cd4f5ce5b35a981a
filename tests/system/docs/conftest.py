"""The example packages of docs/, installed as their reader would."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.example_packages import forget_drivers, install


@pytest.fixture(scope="module")
def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder where the packages that the module names as `EXAMPLES` are installed."""
    folder = tmp_path_factory.mktemp("site")
    install(folder, request.module.EXAMPLES)
    return folder


@pytest.fixture
def _installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", str(site))
    forget_drivers()
    yield
    forget_drivers()
