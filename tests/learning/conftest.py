"""Without the extra 'learn', only tests that do not need it are collected; and a fishd for them."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from rigs.processes import Daemon, running, sets

EXTRA = ("gymnasium", "joblib", "onnx", "onnxruntime", "stable_baselines3", "tensorboard", "torch")
MISSING = [name for name in EXTRA if find_spec(name) is None]
WITHOUT = ("test_learning_curves.py", "test_learning_settings.py")


def pytest_report_header() -> str | None:
    return f"tests/learning: most are left out, without {', '.join(MISSING)}" if MISSING else None


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    is_test = collection_path.name.startswith("test_")
    return True if MISSING and is_test and collection_path.name not in WITHOUT else None


@pytest.fixture(scope="module")
def shared_daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    settings = sets("simulation.noise=0.001", "tick=0.05")
    with running(tmp_path_factory.mktemp("daemon"), *settings) as found:
        yield found


@pytest.fixture
def daemon(shared_daemon: Daemon) -> Daemon:
    """One for all tests of a module, at rest whatever the test before has done with it."""
    return shared_daemon.at_rest()
