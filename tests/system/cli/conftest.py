"""A virtual Pi, a fishd on it, and somebody who talks to fishctl."""

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
    """A fishd that answers does so, however busy the machine is."""
    for module in (base, service):
        monkeypatch.setattr(module, "ANSWER_TIMEOUT_S", 10.0)


@pytest.fixture
def hurried_doctor(_patient_doctor: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """It gives up soon, where nothing answers and that is the point."""
    for module in (base, service):
        monkeypatch.setattr(module, "ANSWER_TIMEOUT_S", 0.5)


@pytest.fixture
def root() -> Iterator[Path]:
    """A tree of files that every user may enter."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def examine(root: Path) -> Examine:
    """Make one check of `fishctl doctor` on the tree, for robot pi."""
    return examiner(root)


@pytest.fixture(scope="session")
def process() -> Iterator[Any]:
    with pi_process() as process:
        yield process


@pytest.fixture
def pi(process: Any, tmp_path: Path) -> Iterator[Bench]:
    """A virtual Pi on which no fishd runs yet."""
    with bench(process, tmp_path) as found:
        yield found


@pytest.fixture(scope="module")
def shared(process: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    with bench(process, tmp_path_factory.mktemp("bench")) as rig, rig.daemon() as daemon:
        yield rig, daemon


@pytest.fixture
def daemon(shared: Shared) -> Daemon:
    """One for all tests of a module, on `rig`, as after its start whatever was done before."""
    rig, daemon = shared
    rig.renew(daemon)
    return daemon


@pytest.fixture
def rig(shared: Shared) -> Bench:
    """The virtual Pi of `daemon`."""
    return shared[0]


@pytest.fixture
def talk() -> Iterator[Talk]:
    with ExitStack() as stack:

        def begin(daemon: Daemon, *arguments: str) -> Dialogue:
            dialogue = Dialogue(daemon, *arguments)
            stack.callback(dialogue.close)
            return dialogue

        yield begin
