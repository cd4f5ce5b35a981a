"""Losses of recordings by kills, and cost of recordings for the ticks.

Recorders and fishds are killed at random times. Lost ticks are counted by comparison with a
subscriber beside the recorder that receives all of them. Then one fishd ticks with and without a
recorder and two subscribers that do not read, in turn. Ends by itself; exit status 1 where a
promise was not kept.
"""

import random
import signal
import subprocess
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import zmq
from msgspec import Struct

from common.daemon import Fishd
from common.machine import machine
from common.processes import BIN
from common.report import Options, Report, progress, quantile, table
from fishd.core.errors import RecordingError
from fishd.recording import open_run

DOCUMENT = "how-to/recording.md"
MAX_LOSS_S = 1.0
"""Largest loss by a kill of the recorder [s]."""
MAX_LATENESS_RATIO = 1.2
"""Largest ratio of the lateness of ticks, p99, with and without a recorder."""
SETTLE = 2.0
"""Time after a change of load in which ticks are ignored [s]."""


class Kill(Struct, frozen=True):
    """One kill, and the ticks before it that were lost."""

    who: str
    lost: int
    """Number of ticks that the subscriber received before the kill, and that the file lacks."""
    torn: bool
    """Whether the file contains a tick twice, or has a gap."""


class Load(Struct, frozen=True):
    """Lateness of the ticks with a recorder or without [µs]."""

    ticks: int
    p50: float
    p99: float
    worst: float


@contextmanager
def recorder(fishd: Fishd, folder: Path, name: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run `fishctl record` on a fishd, and yield it when it records."""
    command = [BIN / "fishctl", "--endpoint", fishd.endpoint, "record", name, "--folder", folder]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + 20.0
        while not ticks_in(folder / f"{name}.mcap.part") and time.monotonic() < until:
            time.sleep(0.1)
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
        process.wait(20.0)


def ticks_in(path: Path) -> list[int]:
    """Return the numbers of the ticks of a recording; empty before it exists."""
    try:
        return [tick.seq for tick in open_run(path).ticks]
    except RecordingError:
        return []


def kill_recorder(fishd: Fishd, folder: Path, name: str, instant: float) -> Kill:
    """Kill a recorder after a time [s], and count the missing ticks of its file."""
    with recorder(fishd, folder, name) as process:
        time.sleep(instant)
        fishd.waiting_messages()
        fishd.next_tick()
        process.send_signal(signal.SIGKILL)
        process.wait()
        heard = fishd.next_tick().seq - 1
    return _judged("recorder", ticks_in(folder / f"{name}.mcap.part"), heard)


def kill_fishd(folder: Path, name: str, instant: float) -> Kill:
    """Kill a fishd after a time [s], and count the missing ticks of its recording."""
    with Fishd() as fishd:
        fishd.next_tick()
        with recorder(fishd, folder, name):
            time.sleep(instant)
            fishd.seconds_to_end(signal.SIGKILL)
            time.sleep(0.2)
            heard = fishd.waiting_ticks()[-1].seq
            time.sleep(1.0)
    return _judged("fishd", ticks_in(folder / f"{name}.mcap"), heard)


def _judged(who: str, ticks: list[int], heard: int) -> Kill:
    whole = ticks == list(range(ticks[0], ticks[-1] + 1)) if ticks else False
    return Kill(who, max(0, heard - (ticks[-1] if ticks else 0)), torn=not whole)


def measure_load(folder: Path, rounds: int, seconds: float) -> tuple[Load, Load]:
    """Return the lateness without and with a recorder and two slow subscribers, in turn."""
    late: dict[bool, list[float]] = {False: [], True: []}
    with Fishd() as fishd:
        fishd.next_tick()
        for number in range(2 * rounds):
            loaded = bool(number % 2)
            with ExitStack() as stack:
                if loaded:
                    stack.enter_context(recorder(fishd, folder, f"load{number}"))
                    stack.enter_context(slow_subscribers(fishd.telemetry))
                time.sleep(SETTLE)
                fishd.waiting_messages()
                time.sleep(seconds)
                late[loaded] += [tick.lateness_us for tick in fishd.waiting_ticks()]
            progress("lateness", "with a recorder" if loaded else "without")
    without, with_ = (
        Load(len(lateness), quantile(lateness, 0.5), quantile(lateness, 0.99), max(lateness))
        for lateness in late.values()
    )
    return without, with_


@contextmanager
def slow_subscribers(address: str) -> Iterator[None]:
    """Run two subscribers that never read, with room for ten messages."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    for _ in range(2):
        socket = context.socket(zmq.SUB)
        socket.set(zmq.RCVHWM, 10)
        socket.subscribe(b"")
        socket.connect(address)
    try:
        yield
    finally:
        context.destroy(linger=0)


def summary(kills: list[Kill], loads: tuple[Load, Load], tick: float) -> str:
    """Return the sections for the document."""
    rows = []
    for who in ("recorder", "fishd"):
        of_it = [kill for kill in kills if kill.who == who]
        lost = sorted(kill.lost for kill in of_it)
        cells = (len(of_it), f"{tick * lost[len(lost) // 2]:.2f}", f"{tick * lost[-1]:.2f}")
        rows.append([who, *map(str, cells), str(sum(kill.torn for kill in of_it))])
    killed = table("killed | times | lost, median [s] | lost, at most [s] | gaps within", rows)
    names = "none", "a recorder and two slow subscribers"
    late = [
        [name, str(load.ticks), *(f"{value:.0f}" for value in (load.p50, load.p99, load.worst))]
        for name, load in zip(names, loads, strict=True)
    ]
    lateness = table("who listens | ticks | p50 [µs] | p99 [µs] | worst [µs]", late)
    ratio = f"p99: {loads[1].p99 / loads[0].p99:.2f} times as large."
    processor, cores = list(machine().values())[:2]
    return f"{killed}\n\n{lateness}\n\n{ratio} {cores} cores of an {processor}."


OPTIONS: Options = {
    "--kills": {"type": int, "default": 20, "help": "of each kind; default 20"},
    "--rounds": {"type": int, "default": 6, "help": "with and without a recorder; default 6"},
    "--seconds": {"type": float, "default": 20.0, "help": "per round; default 20"},
    "--seed": {"type": int, "default": 1},
}


def measure(options: Namespace) -> Report:
    """Run the kills and measure lateness; takes about eight minutes."""
    instants = random.Random(options.seed)
    kills = []
    with tempfile.TemporaryDirectory(prefix="fishd-") as name:
        folder = Path(name)
        with Fishd() as fishd:
            fishd.next_tick()
            for number in range(options.kills):
                instant = instants.uniform(0.5, 2.5)
                kills.append(kill_recorder(fishd, folder, f"recorder{number}", instant))
                progress("kills of the recorder", str(number + 1), f"lost {kills[-1].lost} ticks")
        for number in range(options.kills):
            kills.append(kill_fishd(folder, f"fishd{number}", instants.uniform(0.0, 2.0)))
            progress("kills of fishd", str(number + 1), f"lost {kills[-1].lost} ticks")
        loads = measure_load(folder, options.rounds, options.seconds)
    tick = 0.05
    broken = (
        any(kill.torn for kill in kills)
        or any(kill.who == "fishd" and kill.lost for kill in kills)
        or max(kill.lost for kill in kills) * tick >= MAX_LOSS_S
        or loads[1].p99 > MAX_LATENESS_RATIO * loads[0].p99
    )
    figures = {"kills": kills, "without": loads[0], "with": loads[1]}
    return Report({"reliability recording": summary(kills, loads, tick)}, figures, broken=broken)
