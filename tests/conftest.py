"""Settings of all tests: which are fast, what is reported, how many threads compute."""

import asyncio
import contextlib
import gc
import inspect
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from _pytest.runner import runtestprotocol
from hypothesis import HealthCheck, settings
from rigs import forked_workers, own_network

from common.processes import PATIENCE
from fishd.core.process import unix_sockets

# Each process computes with one thread; set before numpy or torch is loaded, here or in a child.
LIBRARIES = "OMP", "OPENBLAS", "MKL", "NUMBA"
for variable in (f"{library}_NUM_THREADS" for library in LIBRARIES):
    os.environ.setdefault(variable, "1")
for variable in ("COLUMNS", "LINES"):  # which workers set; a terminal reports its size itself
    os.environ.pop(variable, None)
os.environ["FISHD_CONFIG"] = ""  # ignores the configuration of a service on this machine
if "--realtime" in sys.argv:  # set before `rigs.processes` is loaded, which chooses the fishd
    os.environ["JUDGES_REAL_TIME"] = "1"

# Hardly any object that is loaded before the first test becomes garbage.
gc.disable()

# The time of an example depends on the machine, so it has no deadline. The examples are the same in
# each run, so that a suite that passes keeps passing; RANDOM_EXAMPLES selects new ones.
settings.register_profile(
    "fishd",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=not os.environ.get("RANDOM_EXAMPLES"),
)
settings.load_profile("fishd")

UNIT = Path(__file__).parent / "unit"
SERVICE_SOCKET = Path("/run/fishd/control")
LONG_MODULES = {
    *("test_unknown_keys", "test_site", "test_measure", "test_reliability", "test_doctor_bench"),
    *("test_window_hour", "test_measured_tail", "test_half_open", "test_socket_files"),
    *("test_estop", "test_cluster", "test_seeds", "test_step_response"),
}
"""Modules with a test that takes longer than ten others; these begin first."""

MAX_LOST_S = 0.03
"""Lost time of the machine [s] above which a failed test of real time is repeated."""
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
"""Program that prints each delay of its wake-up that is longer than a limit [s]."""


@pytest.fixture
def sigint_ignored() -> Iterator[None]:
    """Ignore SIGINT, as the daemon does: a KeyboardInterrupt then comes only from a `raise`."""
    before = signal.signal(signal.SIGINT, lambda number, frame: None)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session", autouse=True)
def own_runtime_folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Let no test find, and move the fish of, a fishd that this user runs."""
    folder = tmp_path_factory.mktemp("runtime")
    folder.chmod(0o700)
    os.environ["XDG_RUNTIME_DIR"] = str(folder)


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


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip files that hold none of the selected tests, without an import.

    With --fast, these are all files outside tests/unit; single slow tests in it are marked `slow`.
    """
    fast, realtime = config.option.fast, config.option.realtime
    if not (fast or realtime) or not collection_path.match("test_*.py"):
        return None
    if realtime:
        return "mark.realtime" not in collection_path.read_text(encoding="utf-8") or None
    return not collection_path.is_relative_to(UNIT) or None


def refuse_processes(event: str, what: tuple[Any, ...]) -> None:
    """Refuse the processes of fast tests, except those that read commit and machine."""
    if event != "subprocess.Popen" or "PYTEST_CURRENT_TEST" not in os.environ:
        return
    if Path(what[0]).name not in {"git", "uname"}:
        raise RuntimeError(f"a test with --fast starts {what[0]}: mark it slow")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give each test process its part of the slow modules first, and then of the fast ones.

    A process gets the tests of a piece of the list, and those that others have left. Slow tests
    mostly wait, so they run beside one another, and the fast ones at the end leave no gaps.
    """
    count = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    slow, fast = (
        _deal([item for item in items if item.path.is_relative_to(UNIT) == is_fast], count)
        for is_fast in (False, True)
    )
    items[:] = [item for part in zip(slow, fast, strict=True) for tests in part for item in tests]


def _deal(items: list[pytest.Item], count: int) -> list[list[pytest.Item]]:
    """Return equal parts, each of modules from all folders; long modules begin first."""
    modules = sorted({item.path for item in items})
    long = [path for path in modules if path.stem in LONG_MODULES]
    place = {path: number % count for number, path in enumerate(modules)}
    rest = sorted(
        (item for item in items if item.path not in long), key=lambda item: place[item.path]
    )
    bounds = [len(items) * k // count for k in range(count + 1)]
    parts = []
    for k, (first, end) in enumerate(pairwise(bounds)):
        part = [item for item in items if item.path in long[k::count]]
        cut = max(0, end - first - len(part)) if end < len(items) else len(rest)
        parts.append(part + rest[:cut])
        rest = rest[cut:]
    return parts


def pytest_collection_finish() -> None:
    """Exclude modules and tests from garbage collection, which would take 0.2 s for them."""
    gc.freeze()
    gc.enable()


class LostTime:
    """Measurement of the time that the machine lost: taken by its host, or in a stall."""

    def __init__(self) -> None:
        limit = MAX_LOST_S + 0.01
        self._watch = subprocess.Popen(
            [sys.executable, "-S", "-E", "-c", STALLS.format(limit=limit)], stdout=subprocess.PIPE
        )
        assert self._watch.stdout
        self._pipe = self._watch.stdout.fileno()
        os.set_blocking(self._pipe, False)
        self._stolen = read_stolen_time()

    def since_last(self) -> float:
        """Return the time lost since the previous call [s]."""
        before, self._stolen = self._stolen, read_stolen_time()
        stalls = b""
        with contextlib.suppress(BlockingIOError):
            stalls = os.read(self._pipe, 65536)
        return max(self._stolen - before, sum(map(float, stalls.split())))

    def close(self) -> None:
        with self._watch:
            self._watch.kill()


LOST_TIME = pytest.StashKey[LostTime]()
WORKERS = pytest.StashKey[forked_workers.Server]()


def read_stolen_time() -> float:
    """Return the processor time of all cores that the host gave to other machines [s]."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Repeat a failed test of real time once, and report it, if the machine lost time meanwhile.

    The host of a virtual machine took the processor away, or the machine stalled: the failure is
    not evidence against fishd. No other test is repeated.
    """
    lost_time = item.config.stash.get(LOST_TIME, None)
    if lost_time is None:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    lost_time.since_last()
    reports = runtestprotocol(item, log=False, nextitem=nextitem)
    lost = lost_time.since_last()
    if lost > MAX_LOST_S and any(report.failed for report in reports):
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


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine, within a generous time."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    names = pyfuncitem._fixtureinfo.argnames
    arguments = {name: pyfuncitem.funcargs[name] for name in names}
    asyncio.run(asyncio.wait_for(pyfuncitem.obj(**arguments), PATIENCE))
    return True


def pytest_sessionstart(session: pytest.Session) -> None:
    if SERVICE_SOCKET.exists() and not unix_sockets.is_deserted(SERVICE_SOCKET):
        pytest.exit(
            "the service fishd runs on this machine, and tests could move its fish: stop it with "
            "sudo systemctl stop fishd",
            returncode=1,
        )
    is_alone = not getattr(session.config.option, "numprocesses", None)
    if is_alone or hasattr(session.config, "workerinput"):  # else it runs no tests itself
        own_network.isolate()
    if session.config.option.realtime:
        session.config.stash[LOST_TIME] = LostTime()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config, specs: list[Any]) -> None:
    """Fork the test processes of the whole suite from one that has loaded large libraries."""
    is_whole = config.args_source is config.ArgsSource.TESTPATHS and not config.option.fast
    if len(specs) > 1 and is_whole:
        server = config.stash[WORKERS] = forked_workers.Server()
        for spec in specs:
            spec.python = server.python


def pytest_unconfigure(config: pytest.Config) -> None:
    if server := config.stash.get(WORKERS, None):
        server.close()
    if lost_time := config.stash.get(LOST_TIME, None):
        lost_time.close()


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print how many tests were skipped, by reason."""
    reports = terminalreporter.stats.get("skipped", [])
    reasons = Counter(str(report.longrepr[2]).removeprefix("Skipped: ") for report in reports)
    if reasons:
        terminalreporter.section("skipped")
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"{count} × {reason}")


@pytest.hookimpl(wrapper=True)
def pytest_report_to_serializable() -> Iterator[Any]:
    """Replace characters of captured output that UTF-8 cannot carry from a worker."""
    return _encodable((yield))


def _encodable(data: Any) -> Any:
    if isinstance(data, str):
        return data.encode("utf-8", "backslashreplace").decode()
    if isinstance(data, dict):
        return {key: _encodable(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return type(data)(_encodable(item) for item in data)
    return data
