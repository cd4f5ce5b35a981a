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


@pytest.fixture(autouse=True)
def _no_service(monkeypatch: pytest.MonkeyPatch) -> None:
    """The configuration of a service on this machine is none of these tests' business."""
    monkeypatch.setenv("FISHD_CONFIG", "")


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
    with bench(process, tmp_path) as found:
        yield found


@pytest.fixture
def daemon(pi: Bench) -> Iterator[Daemon]:
    with pi.daemon() as daemon:
        yield daemon


@pytest.fixture
def talk() -> Iterator[Talk]:
    with ExitStack() as stack:

        def begin(daemon: Daemon, *arguments: str) -> Dialogue:
            dialogue = Dialogue(daemon, *arguments)
            stack.callback(dialogue.close)
            return dialogue

        yield begin
