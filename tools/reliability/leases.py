"""Kills of experiments on a running fishd at random times, and time until its fish is at rest.

In each lane a real fishd controls the simulated fish, and the verbs of fishctl run on it, one after
another, forked from a process that has loaded all modules. A verb is killed, or stopped, 0 to
`WINDOW` seconds after it has taken the lease of the fish. The exit status is 1 if a fish was not at
rest within the lease plus `GRACE` seconds, including its fade to neutral.
"""

import multiprocessing
import os
import random
import select
import signal
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path

from msgspec import Struct

from common.daemon import Fishd
from common.report import Options, Report, progress, table
from fishd.cli import main as fishctl
from fishd.client import Fish
from reliability.kills import TIMEOUT_S, run, serve_forks

DOCUMENT = "reference/reliability.md"
LEASE = 2.0
"""Time that a lease lasts, by default [s]."""
GRACE = 0.5
"""Time after the lease until a fish must be at rest [s]."""
TICK = 0.05
"""Period of the loop, by default [s]."""
WINDOW = 6.0
"""Interval after the start of the lease in which kills occur [s]; an experiment rests for about 3 s
at first, and then swims."""
STOPPED = 0.15
"""Fraction of the kills that are a SIGSTOP instead."""
ATTEMPTS = 5
"""Attempts at one kill; see `Lane.kill`."""
QUIET = 0.3
"""Time at neutral, after a lease has ended, from which on a fish is at rest [s]."""

FREE = ("--folder", "{folder}")
VERBS: dict[str, tuple[str, ...]] = {
    "measure": ("measure", "swing", "--for", "60"),
    "optimise": ("optimise", "square", "--over", "frequency=1:3", "--on", "live", *FREE),
    "sweep": ("sweep", "square", "--frequency", "1,1.5,2", "--on", "live", *FREE),
    "compare": ("compare", "swing", "sine", "--on", "live"),
    "identify": ("identify", "--experiment", "--on", "live"),
    "adapt": ("adapt", "--on", "live", *FREE),
}
MODULES = (
    "fishd.cli.adapt",
    "fishd.cli.compare",
    "fishd.cli.identify",
    "fishd.cli.measure",
    "fishd.cli.optimise",
    "fishd.cli.sweep",
    "fishd.lab.compare.piloted_session",
    "fishd.lab.drawing",
    "fishd.lab.identification",
    "fishd.lab.optimise.trials",
    "fishd.lab.sweep.measuring",
    "fishd.learning.adapt.adaptation",
    "fishd.learning.adapt.report",
    "onnxruntime",
    "tensorboard",
)
"""Modules that the verbs import, so that each of them starts in a fraction of a second."""


class Kill(Struct):
    """One kill, and the motion of the fish after it."""

    verb: str
    stopped: bool
    """Whether SIGSTOP was sent instead of SIGKILL."""
    after: float
    """From the start of the lease to the kill [s]."""
    swimming: bool
    """Whether a controller was active at that moment."""
    idle: float
    """Time from the kill until the last tick in mode running [s]."""
    rest: float
    """Time from the kill until the last tick away from neutral [s]; infinite where it swims on."""
    faults: int = 0
    """Number of previous attempts in which a delay of fishd caused a fault."""
    losses: int = 0
    """Number of previous attempts in which a delay of the experiment lost its lease."""


class Lane:
    """Running fishd, and the experiments on it."""

    def __init__(self, folder: Path, seed: int, zygote: Connection) -> None:
        """zygote: forks a fishctl for a command line, and answers with its process number"""
        self.folder = folder
        self.random = random.Random(seed)
        self._zygote = zygote
        self._count = 0
        self._daemon = Fishd("start.controller=null")
        self._daemon.next_tick()

    def close(self) -> None:
        """End fishd."""
        self._daemon.__exit__()

    def kill(self, verb: str, stop: bool) -> Kill:
        """Start an experiment, kill or stop it, and observe its fish; retry invalid attempts.

        An attempt is invalid if a busy machine has delayed fishd or the experiment before the kill.
        """
        voids: list[str] = []
        while len(voids) < ATTEMPTS:
            with Fish(self._daemon.endpoint, timeout=TIMEOUT_S) as fish:
                kill = self._try(fish, verb, stop)
                fault = fish.status().reason is not None
                fish.clear_fault()
                fish.stop()
            if kill and not fault:
                kill.faults, kill.losses = voids.count("fault"), voids.count("loss")
                return kill
            voids.append("fault" if fault else "loss")
        raise SystemExit(self._log())

    def _try(self, fish: Fish, verb: str, stop: bool) -> Kill | None:
        """Return the result; None where there was no experiment to kill."""
        self._count += 1
        words = [word.format(folder=self.folder / f"{verb}{self._count}") for word in VERBS[verb]]
        process = self._begin(words)
        try:
            if not self._await_lease(fish):
                return None
            after = self.random.uniform(0.0, WINDOW)
            time.sleep(after)
            self._daemon.waiting_messages()
            swimming = fish.status().mode == "running"
            try:
                signal.pidfd_send_signal(process, signal.SIGSTOP if stop else signal.SIGKILL)
            except ProcessLookupError:
                return None
            idle, rest = self._watch(fish, time.monotonic())
            return Kill(verb, stop, after, swimming, idle, rest)
        finally:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(process, signal.SIGKILL)
            select.select([process], [], [], TIMEOUT_S)
            os.close(process)

    def _begin(self, words: list[str]) -> int:
        self._zygote.send(["fishctl", "--endpoint", self._daemon.endpoint, *words])
        try:
            return os.pidfd_open(self._zygote.recv())
        except ProcessLookupError:
            raise SystemExit(self._log()) from None

    def _log(self) -> str:
        return f"no experiment: {(self.folder / 'log').read_text(encoding='utf-8')[-2000:]}"

    def _await_lease(self, fish: Fish) -> bool:
        """Wait until an experiment holds the fish; False where fishd is in mode fault."""
        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline:
            status = fish.status()
            if status.reason or status.lease:
                return status.reason is None
            time.sleep(0.02)
        raise SystemExit(self._log())

    def _watch(self, fish: Fish, killed: float) -> tuple[float, float]:
        """Return times from the kill to the last tick in mode running, and away from neutral."""
        idle = rest = killed
        limit = killed + LEASE + GRACE + 3.0
        while True:
            tick = self._daemon.next_tick()
            if tick.time > killed:
                idle = tick.time if tick.mode == "running" else idle
                rest = tick.time if tick.phi_c != 0.0 else rest
            if tick.time > limit and tick.time - rest < QUIET:
                return idle - killed, float("inf")
            if tick.time - max(idle, rest, killed) > QUIET and fish.status().lease is None:
                return idle - killed, rest - killed


def fishctl_of(words: list[str]) -> Callable[[], None]:
    """Return the function of a fishctl with this command line."""

    def run() -> None:
        sys.argv = words
        try:
            fishctl.main()
        except SystemExit as ended:
            print(f"{words}: exit status {ended.code}", flush=True)
        os._exit(0)

    return run


def work(kills: list[tuple[str, bool]], seed: int, deadline: float, results: Connection) -> None:
    """Perform these kills one after another, and send the results."""
    with tempfile.TemporaryDirectory(prefix="fishd-") as name:
        folder = Path(name)
        ours, theirs = multiprocessing.Pipe()
        if os.fork() == 0:
            ours.close()
            os.chdir(folder)
            serve_forks(theirs, folder / "log", fishctl_of)
        theirs.close()
        lane = Lane(folder, seed, ours)
        try:
            for verb, stop in kills:
                if time.monotonic() > deadline:
                    break
                results.send(lane.kill(verb, stop))
        finally:
            lane.close()
            ours.close()
            os.wait()
    results.close()


def in_time(kill: Kill) -> bool:
    """Return whether the fish was at rest in time, including its fade."""
    return kill.rest + TICK <= LEASE + GRACE


def summary(kills: list[Kill], seed: int) -> str:
    """Return one row for each verb, and one for all."""
    rows = []
    for verb in [*VERBS, "all"]:
        of_it = [kill for kill in kills if verb in (kill.verb, "all")]
        if not of_it:
            continue
        swam = [kill for kill in of_it if kill.swimming]
        idle, rest = (
            max((getattr(k, name) for k in of_it), default=0.0) for name in ("idle", "rest")
        )
        rows.append(
            [
                f"`fishctl {verb}`" if verb != "all" else "all",
                f"{len(of_it)}, {sum(kill.stopped for kill in of_it)}",
                str(len(swam)),
                f"{idle:.2f}",
                f"{rest:.2f}",
                f"{sum(map(in_time, of_it))} of {len(of_it)}",
            ]
        )
    head = (
        "experiment | kills, of them SIGSTOP | while it swam | last tick in mode `running`, at "
        f"most [s] | last tick away from neutral, at most [s] | at rest within {LEASE + GRACE:g} s"
    )
    faults, losses = (sum(getattr(kill, name) for kill in kills) for name in ("faults", "losses"))
    about = f"Seed {seed}; kills from 0 to {WINDOW:g} s after an experiment took the fish."
    if faults or losses:
        about += (
            f" Void, since the machine was too busy: {faults} in which fishd was in mode fault, "
            f"{losses} in which the experiment had lost its lease before."
        )
    return f"{table(head, rows)}\n\n{about}"


OPTIONS: Options = {
    "--kills": {"type": int, "default": 100, "help": "of each verb; default 100"},
    "--lanes": {"type": int, "default": 2, "help": "fishds side by side; default 2"},
    "--seed": {"type": int, "default": 1, "help": "of the instants; default 1"},
    "--limit": {"type": float, "default": 7200.0, "help": "longest time [s]"},
    "--verb": {"choices": list(VERBS), "help": "this one only"},
}


def measure(options: Namespace) -> Report:
    """Run the kills, and return the table."""
    for module in MODULES:
        import_module(module)
    verbs = [options.verb] if options.verb else list(VERBS)
    shuffled = random.Random(options.seed)
    planned = [
        (verb, number < round(STOPPED * options.kills))
        for verb in verbs
        for number in range(options.kills)
    ]
    shuffled.shuffle(planned)
    kills: list[Kill] = []
    for kill in run(planned, options.lanes, options.seed, options.limit, work):
        kills.append(kill)
        what = "SIGSTOP" if kill.stopped else "SIGKILL"
        times = f"{kill.after:.2f} s | {kill.idle:.2f} s | {kill.rest:.2f} s"
        progress(str(len(kills)), kill.verb, what, times, f"void {kill.faults + kill.losses}")
    broken = not all(map(in_time, kills))
    return Report({"reliability leases": summary(kills, options.seed)}, kills, broken)
