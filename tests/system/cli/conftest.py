"""A virtual Pi, a fishd on it, and dialogues with fishctl."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from rigs.doctor_tree import Examine, examiner
from rigs.operator_rig import Bench, Dialogue, Talk, bench, pi_process
from rigs.processes import Daemon

from fishd.cli.doctor import base, service

Shared = tuple[Bench, Daemon]


@pytest.fixture(autouse=True)
def _patient_doctor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give fishd a long time to answer, so that a busy machine fails no test."""
    for module in (base, service):
        monkeypatch.setattr(module, "ANSWER_TIMEOUT_S", 10.0)


@pytest.fixture
def hurried_doctor(_patient_doctor: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give fishd a short time to answer, for tests in which nothing answers."""
    for module in (base, service):
        monkeypatch.setattr(module, "ANSWER_TIMEOUT_S", 0.5)


@pytest.fixture
def root() -> Iterator[Path]:
    """Folder that every user may enter, for a tree of files."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def examine(root: Path) -> Examine:
    """Function that runs one check of `fishctl doctor` on the tree, for robot pi."""
    return examiner(root)


@pytest.fixture(scope="session")
def process() -> Iterator[Any]:
    with pi_process() as process:
        yield process


@pytest.fixture
def pi(process: Any, tmp_path: Path) -> Iterator[Bench]:
    """Virtual Pi without a fishd."""
    with bench(process, tmp_path) as rig:
        yield rig


@pytest.fixture(scope="module")
def shared(process: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    with bench(process, tmp_path_factory.mktemp("bench")) as rig, rig.daemon() as daemon:
        yield rig, daemon


@pytest.fixture
def daemon(shared: Shared) -> Daemon:
    """The fishd of all tests of a module, on `rig`, reset to its state after the start."""
    rig, daemon = shared
    rig.renew(daemon)
    return daemon


@pytest.fixture
def rig(shared: Shared) -> Bench:
    """Virtual Pi of `daemon`."""
    return shared[0]


@pytest.fixture
def talk() -> Iterator[Talk]:
    with ExitStack() as stack:

        def begin(daemon: Daemon, *arguments: str) -> Dialogue:
            dialogue = Dialogue(daemon, *arguments)
            stack.callback(dialogue.close)
            return dialogue

        yield begin
