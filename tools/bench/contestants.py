"""What `bench_tick.py` lets run side by side: fishd itself, two plain Python loops, cyclictest.

Every contestant is a process of its own, so that none warms a cache or holds an interpreter for
another. Run as a script, this module is one of the plain loops.
"""

import asyncio
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import msgspec
import zmq
from msgspec import Struct

from fishd.client import Fish
from fishd.signals import Status, Tick

PLAIN_LOOPS = {
    "asyncio": "asyncio.sleep to absolute deadlines",
    "sleep": "time.sleep of one period, relative",
}
LONGEST = 100_000
"""Range of cyclictest's histogram [µs]; later wake-ups count as this."""


class Lateness(Struct, frozen=True):
    """How late a contestant was over one round [µs]."""

    contestant: str
    p50: float
    p99: float
    worst: float
    missed: float
    """Share of slots that passed while it was late."""
    drift: float | None
    """How much later ticks came at the end than at the start; None where it is not known."""


def quantile(values: Sequence[float], share: float) -> float:
    """The value that `share` of all values do not exceed."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def lateness(
    contestant: str, period: float, late: Sequence[float], offsets: Sequence[float]
) -> Lateness:
    """Sum a round up.

    late: how late each tick was [s]
    offsets: when it began, less the whole periods since the first one [s]; none where not known
    """
    p50, p99, worst = (quantile(late, share) * 1e6 for share in (0.5, 0.99, 1.0))
    missed = sum(int(one / period) for one in late)
    drift = None
    if offsets:
        tenth = max(1, len(offsets) // 10)  # medians of these: one late tick is no drift
        drift = (quantile(offsets[-tenth:], 0.5) - quantile(offsets[:tenth], 0.5)) * 1e6
    return Lateness(contestant, p50, p99, worst, missed / (len(late) + missed), drift)


class PlainLoop:
    """A loop as one writes it without much thought, in a process of its own."""

    def __init__(self, kind: str, period: float, seconds: float, priority: int) -> None:
        self._name = PLAIN_LOOPS[kind]
        self._period = period
        command = [sys.executable, __file__, kind, str(period), str(seconds), str(priority)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def result(self) -> Lateness:
        """Wait for the end of the round."""
        output, _ = self._process.communicate()
        late, offsets = json.loads(output)
        return lateness(self._name, self._period, late, offsets)

    def kill(self) -> None:
        """End it early; does nothing once it has ended."""
        self._process.kill()


class CyclicTest:
    """The kernel community's yardstick: C, clock_nanosleep to absolute deadlines."""

    def __init__(self, period: float, seconds: float, priority: int) -> None:
        self._period = period
        policy = [f"--priority={priority}"] if priority else ["--policy=other"]
        # --laptop: without it cyclictest keeps the CPUs out of deep sleep, for every contestant.
        command = ["cyclictest", "--quiet", "--mlockall", "--laptop", *policy]
        command += [f"--interval={period * 1e6:.0f}", f"--histogram={LONGEST}"]
        command += [f"--duration={max(1, seconds):.0f}"]
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def result(self) -> Lateness:
        """Wait for the end of the round; raises RuntimeError when cyclictest failed."""
        output, errors = self._process.communicate()
        if self._process.returncode:
            raise RuntimeError(f"cyclictest failed: {errors.strip()}")
        late: list[float] = []
        worst = 0.0
        for line in output.splitlines():
            words = line.split()
            if line.startswith("# Max Latencies:"):
                worst = float(words[-1])
            elif line.startswith("# Histogram Overflows:"):
                late += [LONGEST * 1e-6] * int(words[-1])
            elif len(words) == 2 and words[0].isdigit() and int(words[1]):
                late += [int(words[0]) * 1e-6] * int(words[1])
        found = lateness("cyclictest", self._period, late, [])
        return msgspec.structs.replace(found, worst=worst)

    def kill(self) -> None:
        """End it early; does nothing once it has ended."""
        self._process.kill()


class Fishd:
    """A real fishd that swings a fish, with sockets of its own; a context manager."""

    def __init__(self, *overrides: str) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="bench-fishd-")
        self.endpoint = f"ipc://{self._folder.name}/control"
        address = f"tcp://127.0.0.1:{_free_port()}"
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set(zmq.RCVHWM, 0)  # ticks wait here, so that nobody else wakes up for them
        self._socket.set(zmq.RECONNECT_IVL, 2)
        self._socket.subscribe(b"tick")
        self._socket.connect(address)
        settings = (
            f"control.address={self.endpoint}",
            f"telemetry.address={address}",
            "start.controller=swing",
            *overrides,
        )
        command = [sys.executable, "-m", "fishd", "--no-print-status"]
        command += [word for setting in settings for word in ("--set", setting)]
        self._log = Path(self._folder.name, "log")
        with self._log.open("wb") as log:
            self.started = time.time()
            self._process = subprocess.Popen(command, stderr=log)

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._context.destroy(linger=0)
        self._folder.cleanup()

    def next_tick(self) -> Tick:
        """Wait for a tick; raises RuntimeError with fishd's log when none comes."""
        if not self._socket.poll(15_000):
            raise RuntimeError(f"fishd does not tick: {self._log.read_text(encoding='utf-8')}")
        return msgspec.json.decode(self._socket.recv_multipart()[1], type=Tick)

    def waiting_ticks(self) -> list[Tick]:
        """All ticks that have come since the last look."""
        found = []
        while self._socket.poll(0):
            found.append(self.next_tick())
        return found

    def status(self) -> Status:
        """What `fishctl status` gets."""
        with Fish(self.endpoint) as fish:
            return fish.status()

    def cpu_seconds(self) -> float:
        """User and system time so far, of all threads and of the gateways [s]."""
        ticks = 0
        for pid in (self.pid, *self.gateways()):
            stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii")
            fields = stat.rpartition(")")[2].split()
            ticks += int(fields[11]) + int(fields[12])
        return ticks / os.sysconf("SC_CLK_TCK")

    def gateways(self) -> list[int]:
        """The processes that fishd has started."""
        children = Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text(encoding="ascii")
        return [int(child) for child in children.split()]

    def memory(self, field: str) -> float:
        """A size of fishd's own process, from /proc/PID/status, such as VmRSS [MB]."""
        status = Path(f"/proc/{self._process.pid}/status").read_text(encoding="utf-8")
        return next(
            int(line.split()[1]) * 1024e-6
            for line in status.splitlines()
            if line.startswith(f"{field}:")
        )


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _asyncio_loop(period: float, count: int) -> list[tuple[float, float]]:
    async def run() -> list[tuple[float, float]]:
        ticks = []
        start = time.monotonic()
        for index in range(1, count + 1):
            deadline = start + index * period
            await asyncio.sleep(deadline - time.monotonic())
            ticks.append((deadline, time.monotonic()))
        return ticks

    return asyncio.run(run())


def _sleep_loop(period: float, count: int) -> list[tuple[float, float]]:
    ticks = []
    now = time.monotonic()
    for _ in range(count):
        deadline = now + period
        time.sleep(period)
        now = time.monotonic()
        ticks.append((deadline, now))
    return ticks


def main(kind: str, period: float, seconds: float, priority: int) -> None:
    """Run one plain loop; print how late its ticks were, and their offsets from whole periods."""
    if priority:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    loop = {"asyncio": _asyncio_loop, "sleep": _sleep_loop}[kind]
    ticks = loop(period, round(seconds / period))
    late = [now - deadline for deadline, now in ticks]
    print(json.dumps((late, [now - k * period for k, (_, now) in enumerate(ticks)])))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
