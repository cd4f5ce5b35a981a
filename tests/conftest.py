"""What holds for every test: which are fast, what may be reported, how many threads compute."""

import gc
import os
import re
import signal
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import settings

# One process per core computes; before numpy or torch is loaded, here and in what tests start.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
for variable in ("COLUMNS", "LINES"):  # which workers have; a terminal says itself how large it is
    os.environ.pop(variable, None)

# Little of what is loaded until the first test begins is ever garbage.
gc.disable()

# How long an example takes says something of the machine only.
settings.register_profile("fishd", deadline=None)
settings.load_profile("fishd")

STOLEN = 0.03
"""A test that fails is judged again if so much was stolen meanwhile [s]."""

SLOW = re.compile(
    r"subprocess|multiprocessing|asyncio|time\.sleep|SystemClock|running\("
    r"|operator_rig|camera_process|pigpiod_client|virtual_pi_process|import torch|fishd\.learning"
)
"""A module of tests that mentions one of these starts processes, waits, or loads torch."""


@pytest.fixture
def sigint_ignored() -> Iterator[None]:
    """As in the daemon, where a KeyboardInterrupt can only be raised by somebody's code."""
    before = signal.signal(signal.SIGINT, lambda number, frame: None)
    yield
    signal.signal(signal.SIGINT, before)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fast", action="store_true", help="only tests on the virtual clock, without processes"
    )
    parser.addoption("--realtime", action="store_true", help="only tests that judge real time")


def pytest_configure(config: pytest.Config) -> None:
    if config.option.fast:
        config.option.markexpr = "not slow and not realtime"
        sys.addaudithook(refuse_processes)
    elif config.option.realtime:
        config.option.markexpr = "realtime"
        os.environ["JUDGES_REAL_TIME"] = "1"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """What has none of the tests that are asked for is not even imported.

    With --fast, these are the slow modules; single slow tests are marked `slow`.
    """
    fast, realtime = config.option.fast, config.option.realtime
    if not (fast or realtime) or not collection_path.match("test_*.py"):
        return None
    if realtime:
        return "mark.realtime" not in collection_path.read_text(encoding="utf-8") or None
    return is_slow(collection_path) or None


def refuse_processes(event: str, what: tuple[Any, ...]) -> None:
    """A fast test starts none but those with which recordings ask for commit and machine."""
    if event != "subprocess.Popen" or "PYTEST_CURRENT_TEST" not in os.environ:
        return
    if Path(what[0]).name not in {"git", "uname"}:
        raise RuntimeError(f"a test with --fast starts {what[0]}: mark it slow")


@cache
def is_slow(module: Path) -> bool:
    return "end_to_end" in module.parts or bool(SLOW.search(module.read_text(encoding="utf-8")))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slow modules first: the many short tests then share the end evenly among the workers."""
    items.sort(key=lambda item: not is_slow(item.path))


def pytest_collection_finish() -> None:
    """Keep the collector away from modules and tests: looking at all of them takes 0.2 s."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """What judges real time is judged again, and that is said, if it fails while the host of a
    virtual machine takes processor time away: that says nothing of fishd. Nothing else is ever
    tried twice.
    """
    if not item.get_closest_marker("realtime"):
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for _ in range(3):
        before = stolen()
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        if stolen() - before < STOLEN or not any(report.failed for report in reports):
            break
        if terminal := item.config.pluginmanager.get_plugin("terminalreporter"):
            taken = f"failed while the host took {stolen() - before:.2f} s away: judged again"
            failures = "\n".join(report.longreprtext for report in reports if report.failed)
            terminal.write_line(f"\n{item.nodeid}: {taken}\n{failures}")
        item.session._setupstate.teardown_exact(None)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def stolen() -> float:
    """Processor time that the host has given to others, of all cores since start [s]."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


@pytest.hookimpl(wrapper=True)
def pytest_report_to_serializable() -> Iterator[Any]:
    """Captured output may hold what no UTF-8 can carry from a worker to the one that reports."""
    return _encodable((yield))


def _encodable(found: Any) -> Any:
    if isinstance(found, str):
        return found.encode("utf-8", "backslashreplace").decode()
    if isinstance(found, dict):
        return {key: _encodable(value) for key, value in found.items()}
    if isinstance(found, list | tuple):
        return type(found)(_encodable(item) for item in found)
    return found
