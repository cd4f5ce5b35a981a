"""What holds for every test: which are fast, what may be reported, how many threads compute."""

import contextlib
import gc
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import HealthCheck, settings

# One process per core computes; before numpy or torch is loaded, here and in what tests start.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
for variable in ("COLUMNS", "LINES"):  # which workers have; a terminal says itself how large it is
    os.environ.pop(variable, None)
os.environ["FISHD_CONFIG"] = ""  # nor is the configuration of a service on this machine used

# Little of what is loaded until the first test begins is ever garbage.
gc.disable()

# How long an example takes says something of the machine only; the examples are the same in each
# run, so that a suite that passes goes on to pass, unless new ones are asked for.
settings.register_profile(
    "fishd",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=not os.environ.get("RANDOM_EXAMPLES"),
)
settings.load_profile("fishd")

UNIT = Path(__file__).parent / "unit"

LOST = 0.03
"""A test of real time that fails is repeated if the machine lost so much time meanwhile [s]."""
STALLS = """
import time
before = time.monotonic()
while True:
    time.sleep(0.01)
    now = time.monotonic()
    if now - before > {limit}:
        print(f"{{now - before - 0.01:.3f}}", flush=True)
    before = now
"""
"""Prints by how much it was woken late, each time that this was long [s]."""


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

    With --fast, these are all but tests/unit; single slow tests there are marked `slow`.
    """
    fast, realtime = config.option.fast, config.option.realtime
    if not (fast or realtime) or not collection_path.match("test_*.py"):
        return None
    if realtime:
        return "mark.realtime" not in collection_path.read_text(encoding="utf-8") or None
    return not collection_path.is_relative_to(UNIT) or None


def refuse_processes(event: str, what: tuple[Any, ...]) -> None:
    """A fast test starts none but those with which recordings ask for commit and machine."""
    if event != "subprocess.Popen" or "PYTEST_CURRENT_TEST" not in os.environ:
        return
    if Path(what[0]).name not in {"git", "uname"}:
        raise RuntimeError(f"a test with --fast starts {what[0]}: mark it slow")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slow modules first: the many short tests then share the end evenly among the workers."""
    items.sort(key=lambda item: item.path.is_relative_to(UNIT))


def pytest_collection_finish() -> None:
    """Keep the collector away from modules and tests: looking at all of them takes 0.2 s."""
    gc.freeze()
    gc.enable()


class LostTime:
    """Processor time that neither fishd nor a test had any use of."""

    def __init__(self) -> None:
        limit = LOST + 0.01
        self._watch = subprocess.Popen(
            [sys.executable, "-S", "-E", "-c", STALLS.format(limit=limit)], stdout=subprocess.PIPE
        )
        assert self._watch.stdout
        self._pipe = self._watch.stdout.fileno()
        os.set_blocking(self._pipe, False)
        self._stolen = stolen()

    def since_last(self) -> float:
        """Return the time that was lost since the call before [s]."""
        before, self._stolen = self._stolen, stolen()
        stalls = b""
        with contextlib.suppress(BlockingIOError):
            stalls = os.read(self._pipe, 65536)
        return max(self._stolen - before, sum(map(float, stalls.split())))

    def close(self) -> None:
        with self._watch:
            self._watch.kill()


LOST_TIME = pytest.StashKey[LostTime]()


def stolen() -> float:
    """Return the processor time, of all cores, that the host has given to others [s]."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Repeat a test of real time once, and say so, if it fails while the machine loses time.

    The host of a virtual machine has taken the processor away, or everything stood still: that
    says nothing of fishd. No other test is ever tried twice.
    """
    lost_time = item.config.stash.get(LOST_TIME, None)
    if lost_time is None:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    lost_time.since_last()
    reports = runtestprotocol(item, log=False, nextitem=nextitem)
    lost = lost_time.since_last()
    if lost > LOST and any(report.failed for report in reports):
        if terminal := item.config.pluginmanager.get_plugin("terminalreporter"):
            failures = "\n".join(report.longreprtext for report in reports if report.failed)
            message = f"failed while the machine lost {lost:.2f} s: repeated once"
            terminal.write_line(f"\n{item.nodeid}: {message}\n{failures}")
        item.session._setupstate.teardown_exact(None)
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_sessionstart(session: pytest.Session) -> None:
    if session.config.option.realtime:
        session.config.stash[LOST_TIME] = LostTime()


def pytest_unconfigure(config: pytest.Config) -> None:
    if lost_time := config.stash.get(LOST_TIME, None):
        lost_time.close()


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say how many tests were skipped, by what would enable them."""
    reports = terminalreporter.stats.get("skipped", [])
    reasons = Counter(str(report.longrepr[2]).removeprefix("Skipped: ") for report in reports)
    if reasons:
        terminalreporter.section("skipped")
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"{count} × {reason}")


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
