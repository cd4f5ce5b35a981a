"""Trials of a real fishd with controllers that raise, return wrong values, or hang."""

import contextlib
import fcntl
import os
import pty
import shutil
import signal
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import zmq
from msgspec import Struct

from common.daemon import TIMEOUT_S, Fishd
from common.processes import BIN
from common.report import DOCS, Options, Report, progress, table
from fishd.client import Fish, NoDaemon, Refused
from fishd.core.protocol import LOADING_TIMEOUT_S
from fishd.daemon.background_calls import MAX_CALLS

ZOO = DOCS.parent / "tests" / "rigs" / "zoo"
MAX_END_S = 3.0
"""Longest time from a signal to the end of fishd, with anything hanging [s]."""
IMPATIENT_FISHD = """
from fishd.core import protocol
protocol.LOADING_TIMEOUT_S = {loading}
from fishd.__main__ import fishd
fishd()
"""
METHODS = ("check", "__init__", "activate", "update", "retune", "close")
DEAD_LINE = 'raise SystemExit("no")\n'
HANGING_LINE = "import threading\n\nthreading.Event().wait()\n"

sys.path.insert(0, str(ZOO))
from fishd_zoo import BAD, GOOD, HANGS, RAISED  # noqa: E402

COMPUTE = ("loop",)
"""Kinds of `HANGS` that use all of a processor."""


class Outcome(Struct):
    """Result of one kind of misbehaviour."""

    what: str
    does: str
    """Reaction of fishd."""
    cases: int
    ended: int
    """Number of trials after which fishd had ended, did not answer, or did not end in time."""
    longest: float | None = None
    """Longest time from the signal to the end of the process [s]."""
    statuses: list[int] = []
    """Observed exit statuses."""


def install(folder: Path, bad_imports: bool = False) -> Path:
    """Install the zoo as a package; bad_imports: include modules that raise or hang."""
    site = folder / "site"
    info = site / "fishd_zoo-1.0.dist-info"
    info.mkdir(parents=True)
    shutil.copy(ZOO / "fishd_zoo.py", site)
    lines = ["[fishd.controllers]", "zoo = fishd_zoo:Zoo"]
    if bad_imports:
        (site / "zoo_dead.py").write_text(DEAD_LINE)
        (site / "zoo_hanging.py").write_text(HANGING_LINE)
        lines += ["dead = zoo_dead:Zoo", "hanging = zoo_hanging:Zoo"]
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fishd-zoo\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return site


@contextlib.contextmanager
def running(
    bad_imports: bool = False, output: int | None = None, loading: float | None = None
) -> Iterator[tuple[Fishd, Fish]]:
    """Run a fishd with the zoo installed, and yield it and a client.

    loading: timeout of a load [s], if not LOADING
    """
    command: tuple[str, ...] = (str(BIN / "fishd"),)
    if loading is not None:
        command = (sys.executable, "-c", IMPATIENT_FISHD.format(loading=loading))
    with tempfile.TemporaryDirectory(prefix="fishd-") as folder:
        fishd = Fishd(
            # A controller in an endless loop must not delay other real-time processes.
            "realtime.priority=5",
            command=(*command, "--print-status"),
            environment={"PYTHONPATH": str(install(Path(folder), bad_imports))},
            output=output,
        )
        with fishd, Fish(fishd.endpoint, timeout=5.0) as fish:
            fishd.next_tick(TIMEOUT_S + LOADING_TIMEOUT_S)
            yield fishd, fish


def await_mode(fish: Fish, mode: str) -> None:
    """Wait for a mode; raises TimeoutError."""
    deadline = time.monotonic() + TIMEOUT_S
    while fish.status().mode != mode:
        if time.monotonic() > deadline:
            raise TimeoutError(f"it is not in mode {mode}")
        time.sleep(0.01)


def survives(fishd: Fishd, fish: Fish, method: str, deed: str) -> bool:
    """Return whether fishd enters a fault or refuses, answers, and continues to tick."""
    before = fish.status().seq
    try:
        try:
            fish.set_controller("zoo", deed=deed, method=method)
            if method in ("activate", "update"):
                await_mode(fish, "fault")
            elif method == "retune":
                fish.set_parameters(nudge=1)
                return False
            elif method != "close":
                return False
        except Refused as refusal:
            if refusal.code not in ("controller-error", "bad-parameter") or method in (
                "activate",
                "update",
                "close",
            ):
                return False
        fish.clear_fault()
        fish.stop()
        await_mode(fish, "idle")
        while fish.status().seq < before + 2:
            time.sleep(0.01)
    except (NoDaemon, TimeoutError):
        return False
    return fishd.process.poll() is None


def raising() -> Outcome:
    """Try every exception in every method."""
    cases = [(method, deed) for method in METHODS for deed in RAISED]
    with running() as (fishd, fish):
        ended = sum(not survives(fishd, fish, *case) for case in cases)
        if fishd.log.stat().st_size > 2_000_000:
            ended += 1
    does = "fault `controller-error`, or a refusal"
    return Outcome("an exception of any kind, in any method", does, len(cases), ended)


def numbers() -> Outcome:
    """Try every odd number as an angle."""
    ended = 0
    with running() as (fishd, fish):
        for deed in GOOD:
            fish.set_controller("zoo", deed=deed)
            time.sleep(0.2)
            ended += fish.status().mode != "running"
        fish.stop()
        ended += sum(not survives(fishd, fish, "update", deed) for deed in BAD)
    does = "a finite real number of any type is applied; else fault `controller-error`"
    return Outcome("odd numbers as an angle", does, len(GOOD) + len(BAD), ended)


def loading(patience: float | None = None) -> Outcome:
    """Try loads that never end: each is refused, and others load.

    Three fishds run at once. The endless computations share one, so that a core remains free.

    patience: timeout of a load [s], if not LOADING
    """
    cases = [(method, way) for way in HANGS for method in ("check", "__init__")]
    computing = [case for case in cases if case[1] in COMPUTE]
    waiting = [case for case in cases if case[1] not in COMPUTE]
    groups = computing, waiting[:MAX_CALLS], waiting[MAX_CALLS:]
    with ThreadPoolExecutor(len(groups)) as pool:
        results = list(pool.map(partial(refused_loads, patience=patience), groups))
    ended, times, statuses = zip(*results, strict=True)
    does = f"refusal `too-slow` after {patience or LOADING_TIMEOUT_S:g} s; others load"
    what = "a load that never ends"
    return Outcome(what, does, len(cases), sum(ended), max(times), sorted(set(statuses)))


def refused_loads(cases: list[tuple[str, str]], patience: float | None) -> tuple[int, float, int]:
    """Return the number of loads not refused, the time to the end [s], the exit status."""
    with running(loading=patience) as (fishd, fish), ThreadPoolExecutor(len(cases)) as pool:
        refusals = list(pool.map(partial(refusal_of_load, fishd.endpoint), cases))
        fish.set_controller("square")
        await_mode(fish, "running")
        ended = len(cases) - refusals.count("too-slow")
        return ended, fishd.seconds_to_end(signal.SIGTERM), fishd.process.returncode


def refusal_of_load(endpoint: str, case: tuple[str, str]) -> str:
    """Request a controller that hangs; return the code of the refusal, or another result."""
    try:
        with Fish(endpoint) as fish:
            fish.set_controller("zoo", deed=case[1], method=case[0])
    except Refused as refusal:
        return refusal.code
    except NoDaemon:
        return "no answer"
    return "loaded"


def importing() -> Outcome:
    """Try packages that raise or hang at their import: the others remain available."""
    with running(bad_imports=True) as (fishd, fish):
        known = {info.name for info in fish.controllers()}
        ended = int(not {"zoo", "swing"} <= known)
        for name in ("dead", "hanging"):
            try:
                fish.set_controller(name)
                ended += 1
            except Refused as refusal:
                ended += refusal.code not in ("unknown-controller", "too-slow")
        took = fishd.seconds_to_end(signal.SIGTERM)
        status = fishd.process.returncode
    does = f"left out, after {LOADING_TIMEOUT_S:g} s at most"
    return Outcome("an import that raises or never ends", does, 2, ended, took, [status])


def ask(fishd: Fishd, method: str, way: str) -> None:
    """Make a method hang, and wait until it does; a hanging load does not delay requests."""
    begun = fishd.folder / "begun"
    zoo = {"deed": way, "method": method, "begun": str(begun)}
    with Fish(fishd.endpoint, timeout=TIMEOUT_S) as fish:
        if method in ("retune", "close"):
            fish.set_controller("zoo", **zoo)  # answered when it is active
        match method:
            case "retune":
                request = fish.request("set-parameter", {"parameters": {"nudge": 1}})
            case "close":
                request = fish.request("stop", {})
            case _:
                request = fish.request("set-controller", {"name": "zoo", "parameters": zoo})
        send(fishd.endpoint, request[1])
    deadline = time.monotonic() + TIMEOUT_S
    while not begun.exists():
        if time.monotonic() > deadline:
            raise TimeoutError("fishd does not hang")
        time.sleep(0.01)


def send(endpoint: str, request: bytes) -> None:
    """Send a request without reading the answer."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.set(zmq.LINGER, 1000)
        socket.connect(endpoint)
        socket.send(request)


def hanging(method: str) -> Callable[[], Outcome]:
    """Send SIGTERM while a method hangs, in every way, with one processor for fishd."""

    def measure() -> Outcome:
        # In parallel, except for those that would take the processor from the others.
        results = ends(method, [way for way in HANGS if way not in COMPUTE])
        for way in COMPUTE:
            results += ends(method, [way])
        times, statuses = zip(*results, strict=True)
        load = method in ("check", "__init__")
        does = "ticks continue" if load else "the countdown ends the pulses; ends at a signal"
        what = f"`{method}` hangs" + (" while it loads" if load else "")
        ended = sum(took > MAX_END_S for took in times)
        return Outcome(what, does, len(HANGS), ended, max(times), sorted(set(statuses)))

    return measure


def ends(method: str, ways: list[str]) -> list[tuple[float, int]]:
    """Return the time from SIGTERM to the end [s] and the exit status for each way to hang.

    SIGTERM is sent after all of them hang, because their starts would disturb it.
    """

    def hang(way: str) -> Fishd:
        fishd, _ = stack.enter_context(running())
        for thread in Path(f"/proc/{fishd.pid}/task").iterdir():
            with contextlib.suppress(ProcessLookupError):  # the process has ended meanwhile
                os.sched_setaffinity(int(thread.name), {min(os.sched_getaffinity(0))})
        ask(fishd, method, way)
        return fishd

    def end(fishd: Fishd) -> tuple[float, int]:
        return fishd.seconds_to_end(signal.SIGTERM), fishd.process.returncode

    with contextlib.ExitStack() as stack, ThreadPoolExecutor(len(ways)) as pool:
        return list(pool.map(end, list(pool.map(hang, ways))))


def unread(number: signal.Signals, terminal: bool) -> Callable[[], Outcome]:
    """Send a signal while the output of fishd is not read."""

    def measure() -> Outcome:
        if terminal:
            reader, writer = pty.openpty()
        else:
            reader, writer = os.pipe()
        fill(writer)
        with running(output=writer) as (fishd, _):
            time.sleep(1.5)  # until a status line is blocked
            took = fishd.seconds_to_end(number)
            status = fishd.process.returncode
        os.close(reader)
        os.close(writer)
        what = f"{number.name}, a {'terminal' if terminal else 'pipe'} without a reader"
        ended = int(took > MAX_END_S or status != 0)
        return Outcome(what, "fades, and loses its last lines", 1, ended, took, [status])

    return measure


def fill(writer: int) -> None:
    """Write until the pipe is full."""
    flags = fcntl.fcntl(writer, fcntl.F_GETFL)
    fcntl.fcntl(writer, fcntl.F_SETFL, flags | os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        while os.write(writer, b"x" * 512):
            pass
    with contextlib.suppress(BlockingIOError):
        while os.write(writer, b"x"):
            pass
    fcntl.fcntl(writer, fcntl.F_SETFL, flags)


KINDS: dict[str, Callable[[], Outcome]] = {
    "raising": raising,
    "numbers": numbers,
    "loading": loading,
    "importing": importing,
    **{f"hanging-{method}": hanging(method) for method in METHODS},
    "unread-pipe": unread(signal.SIGTERM, terminal=False),
    "unread-terminal": unread(signal.SIGTERM, terminal=True),
    "hangup": unread(signal.SIGHUP, terminal=True),
}


def row(outcome: Outcome) -> list[str]:
    """Return a row of the table."""
    took = "–" if outcome.longest is None else f"{outcome.longest:.2f}"
    statuses = ", ".join(map(str, outcome.statuses)) or "–"
    return [outcome.what, outcome.does, str(outcome.cases), str(outcome.ended), took, statuses]


OPTIONS: Options = {
    "--only": {"choices": list(KINDS), "help": "this kind"},
}


def measure(options: Namespace) -> Report:
    """Try every kind of misbehaviour; takes three minutes."""
    outcomes = {}
    for name in [options.only] if options.only else KINDS:
        outcomes[name] = KINDS[name]()
        progress(*row(outcomes[name]))
    head = (
        "what a controller does | what fishd does | cases | ends of fishd | "
        "longest from SIGTERM to the end [s] | exit status"
    )
    rows = map(row, outcomes.values())
    ended = any(outcome.ended for outcome in outcomes.values())
    number = (
        f"{sum(outcome.ended for outcome in outcomes.values())} ends of fishd in "
        f"{sum(outcome.cases for outcome in outcomes.values())} cases; from SIGTERM to the end at "
        f"most {max(outcome.longest or 0.0 for outcome in outcomes.values()):.2f} s"
    )
    text = table(head, rows)
    return Report({"reliability misbehaviour": text}, outcomes, broken=ended, number=number)
