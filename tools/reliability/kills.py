"""Kills of fishd at random times and in random situations, with a check that its pulses end.

Each lane has a virtual Pi and, one after another, real fishds on it. They are forked from a process
that has loaded all modules, which makes them fast. A kill is stuck when the servo still gets pulses
1.5 s later. Ends by itself; exit status 1 when one was stuck.
"""

import asyncio
import itertools
import multiprocessing
import os
import random
import select
import signal
import sys
import tempfile
import threading
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from msgspec import Struct

from common.daemon import virtual_pi
from common.report import Options, Report, progress, table
from fishd.client import Fish
from fishd.config import Config, load
from fishd.core.errors import FishdError
from fishd.core.process.shutdown import Shutdown
from fishd.daemon.main import swim
from fishd.virtual.pi.virtual_pi import VirtualPi

DOCUMENT = "reference/reliability.md"
GPIO = 18
TIMEOUT_S = 120.0
SWIM_TIMEOUT_S = 5.0
"""Time until a fishd must swim [s]; after it, another one is started with a longer timeout."""
WATCHED = 1.5
"""Time after a kill from which there must be no pulses [s]."""
STOPPED = 0.15
"""Fraction of the kills that are a SIGSTOP instead: a process that hangs, and keeps its sockets."""
POLICY = {"policy": "default-fish"}


class Situation(Struct):
    """Situation of fishd when it is killed."""

    what: str
    """Description for the table."""
    share: int
    """Number per hundred kills."""
    window: float
    """Length of the interval after the action in which the kill occurs at random [s]."""
    deed: Callable[["Lane"], None]


class Kill(Struct):
    """One kill, and the servo pulses after it."""

    situation: str
    stopped: bool
    """Whether SIGSTOP was sent instead of SIGKILL."""
    after: float
    """Time from the action to the kill [s]."""
    swimming: bool
    """Whether there were pulses at that moment."""
    off: float | None
    """Time from the kill to the end of the last pulse [s]; None: pulses continue."""
    width: float
    """Width of the continuing pulses [µs]; 0 without pulses."""


class Lane:
    """Virtual Pi, and the fishd that swims on it."""

    def __init__(
        self,
        folder: Path,
        pi: VirtualPi,
        on_it: list[str],
        zygote: Connection,
        number: random.Random,
    ) -> None:
        """on_it: settings of a fishd on this virtual Pi; zygote: forks a fishd for settings"""
        self.folder = folder
        self.pi = pi
        self._on_it = on_it
        self.random = number
        self.endpoint = f"ipc://{folder}/control"
        self._zygote = zygote
        self._pidfd = -1

    def swim(self) -> None:
        """Start a fishd, and wait until its tail beats; retry where a busy machine disturbs it."""
        deadline = time.monotonic() + TIMEOUT_S
        for attempt in itertools.count(1):
            if time.monotonic() > deadline:
                break
            self.start()
            beats = self._beats()
            until = time.monotonic() + SWIM_TIMEOUT_S * attempt
            while time.monotonic() < until:
                if self._beats() >= beats + 3:
                    return
                time.sleep(0.005)
            self.end()
        raise SystemExit(f"fishd does not swim: {(self.folder / 'log').read_text()[-2000:]}")

    def start(self) -> None:
        """Start a fishd."""
        pairs = {
            "force_sensor.data_rate": 128,  # a low load on a busy machine
            "servo.timeout": self.random.choice((0.008, 0.02, 0.1)),
            "state_folder": self.folder / "state",
            "control.address": self.endpoint,
            "telemetry.address": f"ipc://{self.folder}/telemetry",
            "start.controller": "square",
            "realtime.priority": 0,
            "realtime.lock_memory": "false",
            "realtime.warm_up": "false",
        }
        self._zygote.send([*self._on_it, *(f"{key}={value}" for key, value in pairs.items())])
        pid = self._zygote.recv()
        with suppress(ProcessLookupError):  # on a busy machine, the previous process may still run
            self._pidfd = os.pidfd_open(pid)

    def signal(self, number: signal.Signals) -> None:
        """Send fishd a signal, if it still runs."""
        if self._pidfd >= 0:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def end(self) -> None:
        """Kill fishd if it still runs, and wait for its end."""
        if self._pidfd >= 0:
            self.signal(signal.SIGKILL)
            select.select([self._pidfd], [], [], TIMEOUT_S)
            os.close(self._pidfd)
            self._pidfd = -1

    def ask(self, request: Callable[[Fish], object]) -> None:
        """Send a request without waiting for the answer."""

        def call() -> None:
            with suppress(FishdError), Fish(self.endpoint, timeout=5.0) as fish:
                request(fish)

        threading.Thread(target=call, daemon=True).start()

    def inject(self, fault: str, seconds: float | None = None) -> None:
        """Start a fault of the virtual Pi."""
        self.pi.faults.inject(fault, seconds)

    def kill(self, name: str, stop: bool) -> Kill:
        """Bring a fishd into a situation, kill or stop it there, and observe its pulses."""
        situation = SITUATIONS[name]
        self.swim()
        time.sleep(self.random.uniform(0.0, 0.2))
        situation.deed(self)
        after = self.random.uniform(0.0, situation.window)
        time.sleep(after)
        self.signal(signal.SIGSTOP if stop else signal.SIGKILL)
        dead = time.monotonic()
        swimming = self._width(dead) > 0.0
        time.sleep(WATCHED)
        now = time.monotonic()
        width = self._width(now)
        changes = [(when, width) for when, width in self.pi.pigpiod.history(GPIO) if when <= now]
        off = None if width else max(0.0, changes[-1][0] - dead)
        self.end()
        if width:  # reset pigpiod for the next fishd
            self.inject("pigpiod-restart")
        return Kill(name, stop, after, swimming, off, width)

    def _beats(self) -> int:
        history = self.pi.pigpiod.history(GPIO)
        return sum(abs(width - 1500.0) > 100.0 for _, width in history if width)

    def _width(self, now: float) -> float:
        return self.pi.pigpiod.width(GPIO, now)


def replace_fishd(lane: Lane) -> None:
    """Kill the running fishd, and start the next one at once."""
    lane.end()
    lane.start()


def clear(fish: Fish) -> None:
    """Send an emergency stop, and clear it after it has acted."""
    fish.estop()
    time.sleep(0.1)
    fish.clear_fault()


SITUATIONS = {
    "swims": Situation("it swims", 10, 0.2, lambda lane: None),
    "starts": Situation("it starts after one that was killed", 16, 0.5, replace_fishd),
    "frozen": Situation(
        "pigpiod hangs for 30 ms, and on",
        22,
        0.12,
        lambda lane: lane.inject("pigpiod-frozen", 0.03),
    ),
    "frozen long": Situation(
        "pigpiod hangs for 0.3 s, and it connects again",
        10,
        0.5,
        lambda lane: lane.inject("pigpiod-frozen", 0.3),
    ),
    "gone": Situation(
        "pigpiod is gone for 50 ms, and it connects again",
        6,
        0.5,
        lambda lane: lane.inject("pigpiod-gone", 0.05),
    ),
    "restart": Situation(
        "pigpiod is started again", 6, 0.4, lambda lane: lane.inject("pigpiod-restart")
    ),
    "stops": Situation("it stops (SIGTERM)", 10, 0.8, lambda lane: lane.signal(signal.SIGTERM)),
    "loads": Situation(
        "it loads a policy",
        6,
        0.6,
        lambda lane: lane.ask(lambda fish: fish.set_controller("ppo", **POLICY)),
    ),
    "estop": Situation(
        "an emergency stop", 10, 0.02, lambda lane: lane.ask(lambda fish: fish.estop())
    ),
    "clears": Situation(
        "a fault is cleared, and it gets pulses again", 4, 0.3, lambda lane: lane.ask(clear)
    ),
}


def order(kills: int, seed: int, only: str | None) -> list[tuple[str, bool]]:
    """Return `count` kills in random order by the seed: situation, and whether to send SIGSTOP."""
    names = [only] * kills if only else situations(kills, seed)
    stops = random.Random(f"stops {seed}")
    return [(name, stops.random() < STOPPED) for name in names]


def situations(kills: int, seed: int) -> list[str]:
    """Return the situations of `count` kills."""
    hundred = [name for name, situation in SITUATIONS.items() for _ in range(situation.share)]
    shuffled = random.Random(seed)
    names = list(itertools.islice(itertools.cycle(shuffled.sample(hundred, len(hundred))), kills))
    shuffled.shuffle(names)
    return names


def serve_forks(
    requests: Connection, log: Path, prepare: Callable[[list[str]], Callable[[], None]]
) -> None:
    """Fork a process for each received list of words, and answer with its number.

    prepare: converts the words to the function of the new process, which never returns
    """
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # children are not awaited
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(output, 1)
    os.dup2(output, 2)
    while True:
        try:
            run = prepare(requests.recv())
        except EOFError:
            os._exit(0)
        pid = os.fork()
        if pid == 0:
            requests.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            run()
        requests.send(pid)


def fishd_of(settings: list[str]) -> Callable[[], None]:
    """Return the function of a fishd with these settings."""
    return partial(be_fishd, load(None, settings))


def be_fishd(config: Config) -> None:
    """Run fishd, and never return."""
    try:
        asyncio.run(swim(config, False, Shutdown()))
    except BaseException as error:
        print(f"fishd: {error!r}", file=sys.stderr, flush=True)
        os._exit(1)
    os._exit(0)


@contextmanager
def lane(folder: Path, seed: int) -> Iterator[Lane]:
    """Run a lane; must be called while its process has one thread, because it forks."""
    ours, theirs = multiprocessing.Pipe()
    if os.fork() == 0:
        ours.close()
        serve_forks(theirs, folder / "log", fishd_of)
    theirs.close()
    try:
        with virtual_pi(folder) as (pi, on_it):
            made = Lane(folder, pi, on_it, ours, random.Random(seed))
            try:
                yield made
            finally:
                made.end()
    finally:
        ours.close()
        os.wait()


def work(kills: list[tuple[str, bool]], seed: int, deadline: float, results: Connection) -> None:
    """Perform these kills one after another, and send the results."""
    with (
        tempfile.TemporaryDirectory(prefix="fishd-") as folder,
        lane(Path(folder), seed) as made,
    ):
        for name, stop in kills:
            if time.monotonic() > deadline:
                break
            results.send(made.kill(name, stop))
    results.close()


def run(
    kills: list[tuple[str, bool]],
    lanes: int,
    seed: int,
    limit: float,
    work: Callable[[list[tuple[str, bool]], int, float, Connection], None] = work,
) -> Iterator[Any]:
    """Yield the results of the kills; those that do not fit into `limit` [s] are left out.

    work: performs the kills of one lane in a separate process, and sends the results
    """
    deadline = time.monotonic() + limit
    waiting: dict[Connection, int] = {}
    for number in range(lanes):
        ours, theirs = multiprocessing.Pipe(duplex=False)
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                work(kills[number::lanes], seed * 1000 + number, deadline, theirs)
                status = 0
            except BaseException as error:
                print(f"lane {number}: {error!r}", file=sys.stderr, flush=True)
            os._exit(status)
        theirs.close()
        waiting[ours] = pid
    while waiting:
        for ours in multiprocessing.connection.wait(list(waiting)):
            try:
                yield ours.recv()
            except EOFError:
                pid = waiting.pop(ours)
                if os.waitpid(pid, 0)[1]:
                    raise SystemExit("a lane has failed, see above") from None


def summary(kills: list[Kill], seed: int) -> str:
    """Return the sections for the document."""
    rows = []
    for name, situation in SITUATIONS.items():
        of_it = [kill for kill in kills if kill.situation == name]
        times = [kill.off for kill in of_it if kill.off is not None]
        if not of_it:
            continue
        stuck = len(of_it) - len(times)
        late = f"{max(times) * 1e3:.0f}" if times else "–"
        swimming = sum(kill.swimming for kill in of_it)
        rows.append([situation.what, *map(str, (len(of_it), swimming, late, stuck))])
    stuck = sum(kill.off is None for kill in kills)
    stopped = sum(kill.stopped for kill in kills)
    rows.append(["all", str(len(kills)), str(sum(kill.swimming for kill in kills)), "", str(stuck)])
    head = "fishd is killed while | kills | with pulses on | pulses off after, at most [ms] | stuck"
    return f"{table(head, rows)}\n\nSeed {seed}; {stopped} of them by SIGSTOP."


OPTIONS: Options = {
    "--kills": {"type": int, "default": 200, "help": "how many; default 200"},
    "--lanes": {"type": int, "default": 4, "help": "how many at a time"},
    "--seed": {"type": int, "default": 1},
    "--only": {"choices": [*SITUATIONS], "help": "this situation"},
    "--limit": {"type": float, "default": 3600.0, "help": "longest time [s]"},
}


def measure(options: Namespace) -> Report:
    """Run the kills; 2000 take a quarter of an hour with 8 lanes."""
    warm_up()
    kills = []
    planned = order(options.kills, options.seed, options.only)
    for kill in run(planned, options.lanes, options.seed, options.limit):
        kills.append(kill)
        if kill.off is None:
            progress(f"stuck: {kill}")
    stuck = any(kill.off is None for kill in kills)
    return Report({"reliability kills": summary(kills, options.seed)}, kills, broken=stuck)


def warm_up() -> None:
    """Load the modules of a fishd, without starting a thread, because it is forked afterwards."""
    import fishd.hardware.force_sensor.sampled_sensor
    import fishd.hardware.servo.pigpio  # noqa: F401
    from fishd.controllers import registry
    from fishd.controllers.policy.runtime import preload

    registry.describe_all()
    preload()
