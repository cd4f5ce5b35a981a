"""Lets the true fishd meet controllers that raise, return and hang whatever they can.

`--write docs/reliability.md` puts the table there; `--only` does a part of it.
"""

import argparse
import contextlib
import fcntl
import os
import pty
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread

import msgspec
from msgspec import Struct
from reports import put, table

from fishd.client import Fish, NoDaemon, Refused
from fishd.protocol import LOADING

ZOO = Path(__file__).parents[1] / "tests" / "zoo"
FISHD = str(Path(sys.executable).with_name("fishd"))
PATIENCE = 20.0
LONGEST_END = 3.0
"""What fishd may take from a signal to its end, whatever hangs [s]."""
METHODS = ("check", "__init__", "activate", "update", "rehearse", "retune", "close")
DEAD_LINE = 'raise SystemExit("no")\n'
HANGING_LINE = "while True:\n    pass\n"

sys.path.insert(0, str(ZOO))
from fishd_zoo import BAD, GOOD, HANGS, RAISED  # noqa: E402


class Outcome(Struct):
    """What came of one kind of misbehaviour."""

    what: str
    does: str
    """What fishd did."""
    cases: int
    ended: int
    """How many of them ended fishd, left it without an answer, or kept it from ending in time."""
    longest: float | None = None
    """Longest time from the signal to the end of the process [s]."""
    statuses: list[int] = []
    """Exit statuses that were seen."""


def install(folder: Path, bad_imports: bool = False) -> Path:
    """The zoo as an installed package; bad_imports: also modules that raise or hang in it."""
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


class Running:
    """A fishd with the zoo installed, and a client of it."""

    def __init__(self, folder: Path, *, bad_imports: bool = False, stderr: int | None = None):
        self.endpoint = f"ipc://{folder}/control"
        own = (f"control.address={self.endpoint}", f"telemetry.address=ipc://{folder}/telemetry")
        self.log = folder / "log"
        environment = {**os.environ, "PYTHONPATH": str(install(folder, bad_imports))}
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [FISHD, *(word for pair in own for word in ("--set", pair)), "--print-status"],
                env=environment,
                stdout=log if stderr is None else stderr,
                stderr=log if stderr is None else stderr,
            )
        self.fish = Fish(self.endpoint, timeout=5.0)

    def wait_until_up(self) -> None:
        """Raises TimeoutError when it does not come up."""
        deadline = time.monotonic() + PATIENCE + LOADING
        while time.monotonic() < deadline and self.process.poll() is None:
            with contextlib.suppress(NoDaemon), Fish(self.endpoint, timeout=0.5) as fish:
                fish.status()
                return
            time.sleep(0.02)
        raise TimeoutError(f"fishd did not come up: {self.log.read_text()}")

    def await_mode(self, mode: str) -> str:
        """Wait for a mode; the code of its reason, if it has one."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            status = self.fish.status()
            if status.mode == mode:
                return status.reason.code if status.reason else ""
            time.sleep(0.01)
        raise TimeoutError(f"it is not in mode {mode}")

    def end(self, number: signal.Signals) -> float:
        """Send a signal; how long the process takes to end [s]."""
        begun = time.monotonic()
        self.process.send_signal(number)
        self.process.wait(PATIENCE)
        return time.monotonic() - begun


@contextlib.contextmanager
def running(bad_imports: bool = False, stderr: int | None = None) -> Iterator[Running]:
    """A fishd that is up, and gone afterwards whatever happens."""
    with tempfile.TemporaryDirectory(prefix="fishd-") as folder:
        daemon = Running(Path(folder), bad_imports=bad_imports, stderr=stderr)
        try:
            daemon.wait_until_up()
            yield daemon
        finally:
            daemon.fish.close()
            daemon.process.kill()
            daemon.process.wait()


def survives(daemon: Running, method: str, deed: str) -> bool:
    """Does fishd take it as a fault or a refusal, answer, and go on ticking?"""
    fish = daemon.fish
    before = fish.status().seq
    try:
        try:
            fish.set_controller("zoo", deed=deed, method=method)
            if method in ("activate", "update", "rehearse"):
                daemon.await_mode("fault")
            elif method == "retune":
                fish.set_parameters(nudge=1)
                return False
            elif method != "close":
                return False
        except Refused as refusal:
            if refusal.code not in ("controller-error", "bad-parameter") or method in (
                "activate",
                "update",
                "rehearse",
                "close",
            ):
                return False
        fish.clear_fault()
        fish.stop()
        daemon.await_mode("idle")
        while fish.status().seq < before + 2:
            time.sleep(0.01)
    except (NoDaemon, TimeoutError):
        return False
    return daemon.process.poll() is None


def raising() -> Outcome:
    """Every exception in every method."""
    cases = [(method, deed) for method in METHODS for deed in RAISED]
    with running() as daemon:
        ended = sum(not survives(daemon, *case) for case in cases)
        if daemon.log.stat().st_size > 2_000_000:
            ended += 1
    does = "fault `controller-error`, or a refusal"
    return Outcome("an exception of any kind, in any method", does, len(cases), ended)


def numbers() -> Outcome:
    """Every odd number as an angle."""
    ended = 0
    with running() as daemon:
        for deed in GOOD:
            daemon.fish.set_controller("zoo", deed=deed)
            time.sleep(0.2)
            ended += daemon.fish.status().mode != "running"
        daemon.fish.stop()
        ended += sum(not survives(daemon, "update", deed) for deed in BAD)
    does = "a finite real number of any type is applied; else fault `controller-error`"
    return Outcome("odd numbers as an angle", does, len(GOOD) + len(BAD), ended)


def loading() -> Outcome:
    """Loads that never end: each is refused, and the next ones find room."""
    cases = [(method, way) for method in ("check", "__init__") for way in HANGS]
    ended = 0
    with running() as daemon:
        for four in (cases[:4], cases[4:]):
            refusals: list[str] = []
            clients = [Fish(daemon.endpoint) for _ in four]
            threads = [
                threading_load(client, method, way, refusals)
                for client, (method, way) in zip(clients, four, strict=True)
            ]
            for thread, client in zip(threads, clients, strict=True):
                thread.join()
                client.close()
            ended += sum(code != "too-slow" for code in refusals) + 4 - len(refusals)
        daemon.fish.set_controller("square")
        daemon.await_mode("running")
        took = daemon.end(signal.SIGTERM)
        status = daemon.process.returncode
    does = f"refusal `too-slow` after {LOADING:g} s; others load"
    return Outcome("a load that never ends", does, len(cases), ended, took, [status])


def threading_load(client: Fish, method: str, way: str, refusals: list[str]) -> Thread:
    """Ask for a controller in a thread, and keep the code of the refusal."""

    def load() -> None:
        try:
            client.set_controller("zoo", deed=way, method=method)
        except Refused as refusal:
            refusals.append(refusal.code)
        except NoDaemon:
            refusals.append("no answer")

    thread = Thread(target=load)
    thread.start()
    return thread


def importing() -> Outcome:
    """Packages that raise or hang when they are imported: the others are there."""
    with running(bad_imports=True) as daemon:
        known = {info.name for info in daemon.fish.controllers()}
        ended = int(not {"zoo", "swing"} <= known)
        for name in ("dead", "hanging"):
            try:
                daemon.fish.set_controller(name)
                ended += 1
            except Refused as refusal:
                ended += refusal.code not in ("unknown-controller", "too-slow")
        took = daemon.end(signal.SIGTERM)
        status = daemon.process.returncode
    does = f"left out, after {LOADING:g} s at most"
    return Outcome("an import that raises or never ends", does, 2, ended, took, [status])


def ask(daemon: Running, method: str, way: str) -> None:
    """Let a method hang; whoever asks gets no answer where the loop itself hangs."""
    with contextlib.suppress(NoDaemon), Fish(daemon.endpoint, timeout=0.5) as fish:
        identity, request = fish.request(
            "set-controller", {"name": "zoo", "parameters": {"deed": way, "method": method}}
        )
        del identity
        send(daemon.endpoint, request)
        if method in ("retune", "close"):
            daemon.await_mode("running")
            op, args = ("stop", {}) if method == "close" else ("set-parameter", {"nudge": 1})
            arguments = {"parameters": args} if args else {}
            send(daemon.endpoint, fish.request(op, arguments)[1])
    time.sleep(0.5)


def send(endpoint: str, request: bytes) -> None:
    """Send a request whose answer nobody reads."""
    import zmq

    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.set(zmq.LINGER, 1000)
        socket.connect(endpoint)
        socket.send(request)


def hanging(method: str) -> Callable[[], Outcome]:
    """SIGTERM while a method hangs, in every way."""

    def measure() -> Outcome:
        times, statuses = [], []
        for way in HANGS:
            with running() as daemon:
                ask(daemon, method, way)
                times.append(daemon.end(signal.SIGTERM))
                statuses.append(daemon.process.returncode)
        load = method in ("check", "__init__")
        does = "goes on ticking" if load else "the countdown ends the pulses; ends when asked to"
        what = f"`{method}` hangs" + (" while it loads" if load else "")
        ended = sum(took > LONGEST_END for took in times)
        return Outcome(what, does, len(HANGS), ended, max(times), sorted(set(statuses)))

    return measure


def unread(number: signal.Signals, terminal: bool) -> Callable[[], Outcome]:
    """A signal while nobody reads what fishd says."""

    def measure() -> Outcome:
        if terminal:
            reader, writer = pty.openpty()
        else:
            reader, writer = os.pipe()
        fill(writer)
        with running(stderr=writer) as daemon:
            time.sleep(1.5)  # a status line, which is stuck
            took = daemon.end(number)
            status = daemon.process.returncode
        os.close(reader)
        os.close(writer)
        what = f"{number.name}, a {'terminal' if terminal else 'pipe'} that nobody reads"
        ended = int(took > LONGEST_END or status != 0)
        return Outcome(what, "fades, and loses its last lines", 1, ended, took, [status])

    return measure


def fill(writer: int) -> None:
    """Write until no more goes in."""
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
    """A line of the table."""
    took = "–" if outcome.longest is None else f"{outcome.longest:.2f}"
    statuses = ", ".join(map(str, outcome.statuses)) or "–"
    return [outcome.what, outcome.does, str(outcome.cases), str(outcome.ended), took, statuses]


def main() -> int:
    """Measure, and print or write the table; 1 if anything ended fishd."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", choices=list(KINDS), help="only this one")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--write", type=Path, help="put the table into this file")
    options = parser.parse_args()
    outcomes = {}
    for name in [options.only] if options.only else KINDS:
        outcomes[name] = KINDS[name]()
        if not options.json:
            print(" | ".join(row(outcomes[name])), flush=True)
    if options.json:
        print(msgspec.json.encode(outcomes).decode())
    if options.write:
        head = [
            "what a controller does",
            "what fishd does",
            "cases",
            "ended it",
            "longest from SIGTERM to the end [s]",
            "exit status",
        ]
        rows = [row(outcome) for outcome in outcomes.values()]
        put(options.write, "misbehaviour", table(head, rows))
    return int(any(outcome.ended for outcome in outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
