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
from fishd.cli.doctor.bench import cyclictest

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
        command = cyclictest.command(period, seconds, priority)
        started.append(Contestant(command, period, _parse_cyclictest))
    return started


def _parse_loop(output: str, period: float) -> Lateness:
    return lateness("asyncio.sleep to absolute deadlines", period, json.loads(output))


def _parse_cyclictest(output: str, period: float) -> Lateness:
    late, worst = cyclictest.parse(output)
    return msgspec.structs.replace(lateness("cyclictest", period, late), worst=worst)
