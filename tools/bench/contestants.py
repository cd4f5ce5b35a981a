"""What `tick` lets run beside fishd: two plain Python loops, and cyclictest.

Every contestant is a process of its own, so that none warms a cache or holds an interpreter for
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
        command = [sys.executable, str(PLAIN_LOOP), kind, str(period), str(seconds), str(priority)]
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
