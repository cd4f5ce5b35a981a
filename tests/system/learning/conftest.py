"""Shared fixtures; without the extra 'learn', only tests that do not need it are collected."""

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from msgspec.structs import replace
from rigs.once import once
from rigs.processes import Daemon, running, sets

if TYPE_CHECKING:
    from fishd.learning.train.jobs import Outcome

EXTRA = ("gymnasium", "joblib", "onnx", "onnxruntime", "stable_baselines3", "tensorboard", "torch")
MISSING = [name for name in EXTRA if find_spec(name) is None]
WITHOUT = ("test_learning_curves.py", "test_learning_settings.py")


def pytest_report_header() -> str | None:
    missing = ", ".join(MISSING)
    return f"tests/system/learning: most are left out, without {missing}" if MISSING else None


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    is_test = collection_path.name.startswith("test_")
    return True if MISSING and is_test and collection_path.name not in WITHOUT else None


@pytest.fixture(scope="module")
def shared_daemon(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Daemon]:
    settings = getattr(request.module, "DAEMON", sets("simulation.noise=0.001", "tick=0.05"))
    with running(tmp_path_factory.mktemp("daemon"), *settings) as process:
        yield process


def trained_once(factory: pytest.TempPathFactory, name: str, **settings: Any) -> "Outcome":
    """Return the outcome of a training of some seconds, which only one test process computes."""
    from rigs.swimming import brief_job

    from fishd.learning.settings import TrainingSettings
    from fishd.learning.train.training import train

    def make(folder: Path) -> "Outcome":
        return train(replace(brief_job(folder / "run"), settings=TrainingSettings(**settings)))

    return once(factory, name, make)


@pytest.fixture(scope="session")
def by_force(tmp_path_factory: pytest.TempPathFactory) -> "Outcome":
    """A run that has learned to swim in a thousand steps; its folder must not be changed."""
    from fishd.learning.settings import EvaluationSettings

    evaluation = EvaluationSettings(seconds=10.0, settle=5.0)
    return trained_once(tmp_path_factory, "by-force", steps=1024, evaluation=evaluation)


@pytest.fixture(scope="session")
def by_sight(tmp_path_factory: pytest.TempPathFactory) -> "Outcome":
    """A run that has learned by sight; its folder must not be changed."""
    from fishd.learning.settings import EvaluationSettings

    evaluation = EvaluationSettings(seconds=6.0, settle=2.0)
    brief = {"steps": 1024, "evaluation": evaluation}
    return trained_once(tmp_path_factory, "by-sight", see="camera", **brief)
