"""Programs that tick beside fishd in `tick`: a plain asyncio loop, and cyclictest.

Each is a separate process, so that none warms a cache or holds an interpreter for another.
"""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence

import msgspec
from msgspec import Struct

from common.report import quantile

PLAIN_LOOP = """
import asyncio, json, os, sys, time

period, count, priority = float(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
if priority:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))

async def run():
    ticks, start = [], time.monotonic()
    for index in range(1, count + 1):
        deadline = start + index * period
        await asyncio.sleep(deadline - time.monotonic())
        ticks.append(time.monotonic() - deadline)
    return ticks

print(json.dumps(asyncio.run(run())))
"""
"""asyncio.sleep to absolute deadlines; prints the lateness of each tick [s]."""
MAX_HISTOGRAM_US = 100_000
"""Range of cyclictest's histogram [µs]; later wake-ups count as this."""


class Lateness(Struct, frozen=True):
    """Lateness of a contestant in one round [µs]."""

    contestant: str
    p50: float
    p99: float
    worst: float
    missed: float
    """Fraction of the slots that were missed."""


def lateness(contestant: str, period: float, late: Sequence[float]) -> Lateness:
    """Return the summary of a round; late: lateness of each tick [s]"""
    p50, p99, worst = (quantile(late, share) * 1e6 for share in (0.5, 0.99, 1.0))
    missed = sum(int(seconds / period) for seconds in late)
    return Lateness(contestant, p50, p99, worst, missed / (len(late) + missed))


class Contestant:
    """Program that ticks in a separate process, and prints its lateness."""

    def __init__(
        self, command: Sequence[str], period: float, parse: Callable[[str, float], Lateness]
    ) -> None:
        self._period, self._parse = period, parse
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def result(self) -> Lateness:
        """Wait for the end of the round; raises RuntimeError when the program failed."""
        output, _ = self._process.communicate()
        if self._process.returncode:
            raise RuntimeError(f"{self._process.args}: exit status {self._process.returncode}")
        return self._parse(output, self._period)

    def kill(self) -> None:
        """End the process early, if it is still running."""
        self._process.kill()


def start_all(period: float, seconds: float, priority: int) -> list[Contestant]:
    """Start the plain loop, and cyclictest where it is installed."""
    count = round(seconds / period)
    loop = [sys.executable, "-c", PLAIN_LOOP, str(period), str(count), str(priority)]
    started = [Contestant(loop, period, _parse_loop)]
    if shutil.which("cyclictest"):
        policy = [f"--priority={priority}"] if priority else ["--policy=other"]
        # Without --laptop, cyclictest keeps the CPUs out of deep sleep, for every contestant.
        command = ["cyclictest", "--quiet", "--mlockall", "--laptop", *policy]
        command += [f"--interval={period * 1e6:.0f}", f"--histogram={MAX_HISTOGRAM_US}"]
        command += [f"--duration={max(1, seconds):.0f}"]
        started.append(Contestant(command, period, _parse_cyclictest))
    return started


def _parse_loop(output: str, period: float) -> Lateness:
    return lateness("asyncio.sleep to absolute deadlines", period, json.loads(output))


def _parse_cyclictest(output: str, period: float) -> Lateness:
    late: list[float] = []
    worst = 0.0
    for line in output.splitlines():
        words = line.split()
        if line.startswith("# Max Latencies:"):
            worst = float(words[-1])
        elif line.startswith("# Histogram Overflows:"):
            late += [MAX_HISTOGRAM_US * 1e-6] * int(words[-1])
        elif len(words) == 2 and words[0].isdigit() and int(words[1]):
            late += [int(words[0]) * 1e-6] * int(words[1])
    return msgspec.structs.replace(lateness("cyclictest", period, late), worst=worst)
