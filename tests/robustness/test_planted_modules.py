"""Files of the working directory are never executed, because another user may have written them."""

import importlib.metadata
import re
import signal
import sys
from pathlib import Path

import pytest
from rigs.documents import ROOT
from rigs.processes import FISHCTL, FISHD, Process, addresses, call, wait_until

from fishd.client import Fish, NoDaemon

NAMES = sorted({*sys.stdlib_module_names, *importlib.metadata.packages_distributions(), "fishd"})
STARTS_PROCESSES = (
    r"^ *(import|from) (joblib|multiprocessing|concurrent|torch.multiprocessing)\b"
    r"(?!\.futures import ((Future, )?ThreadPoolExecutor(, wait)?|CancelledError)$)|SubprocVecEnv\("
)
"""Pattern of code that starts Python processes; threads are none."""


class Trap:
    """Folder with a module of every known name, each of which leaves a mark."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "trap"
        self.folder.mkdir()
        self._mark = folder / "executed"
        code = f"open({str(self._mark)!r}, 'a').write(__name__ + ' ')\nraise ImportError(__name__)"
        for name in filter(str.isidentifier, NAMES):
            (self.folder / f"{name}.py").write_text(code)

    @property
    def executed(self) -> list[str]:
        """Return the names of the modules that a process has executed."""
        return self._mark.read_text().split() if self._mark.exists() else []


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Trap:
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    return Trap(tmp_path)


def test_the_trap_works(trap: Trap) -> None:
    call(sys.executable, "-m", "joblib", cwd=trap.folder)
    assert trap.executed


@pytest.mark.parametrize(
    "words",
    [
        "sweep square --frequency 1,2 --periods 2 --settle 1 --jobs 2 --folder {folder}/sweep",
        "doctor --set realtime.priority=1",
    ],
)
def test_no_verb_executes_files_of_the_working_directory(words: str, trap: Trap) -> None:
    folder = trap.folder.parent
    done = call(FISHCTL, *words.format(folder=folder).split(), cwd=trap.folder, timeout=200)
    assert trap.executed == []
    assert done.returncode in ((0, 1) if words.startswith("doctor") else (0,)), done.stderr


START_WITH_CV2 = """
import subprocess, sys
import cv2
from fishd.core.process.safe_path import SafeChildren

child = [sys.executable, "-c", ""]
assert subprocess.run(child, stderr=subprocess.DEVNULL).returncode != 0
with SafeChildren():
    subprocess.run(child, check=True)
"""
"""Program that starts Python without protection, which takes the library from the folder, and with
it."""


def test_a_child_of_a_process_that_has_loaded_cv2_takes_no_library_from_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cv2", reason="install the extra 'camera'")
    monkeypatch.delenv("LD_LIBRARY_PATH", raising=False)
    (tmp_path / "libc.so.6").touch()
    call(sys.executable, "-c", START_WITH_CV2, cwd=tmp_path, check=True)


def test_fishd_and_its_gateways_do_not_execute_them(trap: Trap) -> None:
    with Process(FISHD, *addresses(trap.folder.parent), cwd=trap.folder) as process:
        endpoint = f"ipc://{trap.folder.parent}/control"
        wait_until(lambda: process.process.poll() is not None or answers(endpoint))
        assert process.process.poll() is None
        status, _, log = process.end(signal.SIGTERM)
    assert trap.executed == []
    assert status == 0, log


def answers(endpoint: str) -> bool:
    try:
        with Fish(endpoint, timeout=1.0) as fish:
            return bool(fish.status())
    except NoDaemon:
        return False


def test_as_a_module_fishd_executes_none_but_those_that_python_loads_first(trap: Trap) -> None:
    loaded = call(sys.executable, "-I", "-c", "import runpy, sys; print(*sys.modules)").stdout
    for name in {"fishd", *loaded.split()}:
        (trap.folder / f"{name}.py").unlink(missing_ok=True)
    done = call(sys.executable, "-m", "fishd", "--set", "tik=1", cwd=trap.folder)
    assert "did you mean 'tick'?" in done.stderr
    assert trap.executed == []


def test_python_is_started_in_one_way() -> None:
    """Allow `safe_path`, a library within `SafeChildren`, and the restart in `__main__`.

    A training thus starts its processes like a sweep.
    """
    for path in (ROOT / "fishd").rglob("*.py"):
        code = path.read_text(encoding="utf-8")
        name = str(path.relative_to(ROOT))
        if name not in ("fishd/core/process/safe_path.py", "fishd/__main__.py"):
            assert not re.search(r"\[\s*sys\.executable|\(sys\.executable,", code), name
        if re.search(STARTS_PROCESSES, code, re.MULTILINE):
            assert "SafeChildren()" in code, name
