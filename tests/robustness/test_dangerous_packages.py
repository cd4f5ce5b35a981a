"""Packages that end, crash or change the process that imports them: fishd survives
and names them.
"""

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.example_packages import forget_drivers
from rigs.processes import PATIENCE, START, call, install, one_line, running

from fishd.controllers import registry
from fishd.core import trial_import
from fishd.core.errors import UnknownController

DANGERS = {
    "exiting": ("import os\nos._exit(0)\n", "its import ends its process with exit status 0"),
    "crashing": (
        "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n",
        "its import ends its process with SIGSEGV",
    ),
    "closing": (
        "import os\nfor number in range(1024):\n"
        "    try:\n        os.close(number)\n    except OSError:\n        pass\n",
        "its import closes files of its process",
    ),
    "endless": ("while True:\n    pass\n", "its import does not end within 10 s"),
    "quitting": ("import sys\nsys.exit(3)\n", "SystemExit: 3"),
}
CHANGING = """
import os, signal
os.chdir("/")
try:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
except ValueError:
    pass  # not in the main thread

from fishd.controllers.hold import Hold


class Harmless(Hold):
    \"\"\"Changes its process.\"\"\"
"""


def packages(folder: Path, *names: str, group: str = "fishd.controllers") -> Path:
    site = folder / "site"
    modules = {f"{name}_module": DANGERS[name][0] for name in names} | {"changing": CHANGING}
    classes = {name: f"{name}_module:Any" for name in names}
    install(site, modules, group=group, **classes, harmless="changing:Harmless")
    return site


@pytest.mark.parametrize("name", sorted(DANGERS))
def test_a_package_that_no_configuration_names_does_not_stop_fishd(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = packages(tmp_path, name)
    monkeypatch.setenv("PYTHONPATH", str(site), prepend=os.pathsep)
    with running(tmp_path) as daemon:
        assert daemon.status().mode == "idle"
        refused = daemon.fishctl_apart("set-controller", name)
        line = f"controller '{name}' ({name}_module:Any in {name} 1.0) does not load: "
        assert f"{line}{DANGERS[name][1]}" in one_line(refused)
        assert daemon.fishctl("set-controller", "harmless").returncode == 0
        assert Path(f"/proc/{daemon.process.pid}/cwd").resolve() == Path.cwd()
        daemon.process.send_signal(signal.SIGTERM)
        assert daemon.process.wait() == 0


@pytest.mark.parametrize("name", sorted(DANGERS.keys() - {"endless"}))
def test_one_that_the_configuration_names_is_named_in_its_refusal(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = packages(tmp_path, name, group="fishd.plants")
    monkeypatch.setenv("PYTHONPATH", str(site), prepend=os.pathsep)
    control = f"control.address=ipc://{tmp_path}/control"
    ended = call(*START, "--set", f"plant.model={name}", "--set", control)
    assert ended.returncode == os.EX_CONFIG
    assert f"in {name} 1.0) does not load: {DANGERS[name][1]}" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.fixture
def new_packages() -> Iterator[None]:
    """Let the registry of controllers read the packages again, before and after a test."""
    forget_drivers()
    yield
    forget_drivers()


SLOW_IN_ITS_TRIAL = """
import sys, time
if "pytest" not in sys.modules:
    time.sleep(9.0)
"""


@pytest.mark.usefixtures("new_packages")
def test_the_trial_takes_no_time_from_the_import_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, {"slow_trial": SLOW_IN_ITS_TRIAL + CHANGING}, slow="slow_trial:Harmless")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(trial_import, "TIMEOUT_S", PATIENCE)
    monkeypatch.setattr(registry, "IMPORT_TIMEOUT_S", 8.5)
    assert [info.name for info in registry.describe_all("slow")] == ["slow"]


def test_an_import_that_did_not_end_in_time_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(trial_import, "TIMEOUT_S", 0.5)
    file = tmp_path / "delayed.py"
    file.write_text(DANGERS["endless"][0])
    assert trial_import.find_danger("delayed") == "its import does not end within 0.5 s"
    file.write_text("delayed = True\n")
    monkeypatch.setattr(trial_import, "TIMEOUT_S", PATIENCE)
    assert trial_import.find_danger("delayed") is None


def test_every_signal_that_ends_an_import_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    number = signal.SIGRTMIN + 1
    (tmp_path / "real_time.py").write_text(f"import os\nos.kill(os.getpid(), {number})\n")
    line = f"its import ends its process with signal {number}"
    assert trial_import.find_danger("real_time") == line


@pytest.mark.usefixtures("new_packages")
def test_a_trial_that_is_not_possible_is_a_reason_not_to_load(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, {"untried": CHANGING}, untried="untried:Harmless")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))  # it was upgraded
    with pytest.raises(UnknownController, match="does not load: FileNotFoundError"):
        registry.find("untried")
