"""Contestants of fishd in `tick`: two plain Python loops, and cyclictest.

Every contestant is a separate process, so that none warms a cache or holds an interpreter for
another.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import msgspec
from msgspec import Struct

from common.report import quantile

PLAIN_LOOPS = {
    "asyncio": "asyncio.sleep to absolute deadlines",
    "sleep": "time.sleep of one period, relative",
}
PLAIN_LOOP = Path(__file__).with_name("plain_loop.py")
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
    drift: float | None
    """Change of the lateness from the start to the end; None where unknown."""


def lateness(
    contestant: str, period: float, late: Sequence[float], offsets: Sequence[float]
) -> Lateness:
    """Return the summary of a round.

    late: lateness of each tick [s]
    offsets: starts of the ticks minus whole periods since the first one [s]; empty where unknown
    """
    p50, p99, worst = (quantile(late, share) * 1e6 for share in (0.5, 0.99, 1.0))
    missed = sum(int(one / period) for one in late)
    drift = None
    if offsets:
        tenth = max(
            1, len(offsets) // 10
        )  # medians of tenths, so that one late tick does not count as drift
        drift = (quantile(offsets[-tenth:], 0.5) - quantile(offsets[:tenth], 0.5)) * 1e6
    return Lateness(contestant, p50, p99, worst, missed / (len(late) + missed), drift)


class PlainLoop:
    """Naive loop in a separate process."""

    def __init__(self, kind: str, period: float, seconds: float, priority: int) -> None:
        self._name = PLAIN_LOOPS[kind]
        self._period = period
        command = [sys.executable, str(PLAIN_LOOP), kind, str(period), str(seconds), str(priority)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def result(self) -> Lateness:
        """Wait for the end of the round, and return the result."""
        output, _ = self._process.communicate()
        late, offsets = json.loads(output)
        return lateness(self._name, self._period, late, offsets)

    def kill(self) -> None:
        """End the process early, if it is still running."""
        self._process.kill()


class CyclicTest:
    """cyclictest, the reference of kernel developers: C, clock_nanosleep to absolute deadlines."""

    def __init__(self, period: float, seconds: float, priority: int) -> None:
        self._period = period
        policy = [f"--priority={priority}"] if priority else ["--policy=other"]
        # Without --laptop, cyclictest keeps the CPUs out of deep sleep, for every contestant.
        command = ["cyclictest", "--quiet", "--mlockall", "--laptop", *policy]
        command += [f"--interval={period * 1e6:.0f}", f"--histogram={MAX_HISTOGRAM_US}"]
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
                late += [MAX_HISTOGRAM_US * 1e-6] * int(words[-1])
            elif len(words) == 2 and words[0].isdigit() and int(words[1]):
                late += [int(words[0]) * 1e-6] * int(words[1])
        summary = lateness("cyclictest", self._period, late, [])
        return msgspec.structs.replace(summary, worst=worst)

    def kill(self) -> None:
        """End the process early, if it is still running."""
        self._process.kill()
