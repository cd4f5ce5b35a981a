"""The program cyclictest, which ticks beside fishd in `tick`: the best that this machine allows."""

import shutil
import subprocess
from collections.abc import Sequence

import msgspec
from msgspec import Struct

from common.report import quantile
from fishd.cli.doctor.bench import cyclictest


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


class Cyclictest:
    """cyclictest in one round, where it is installed."""

    def __init__(self, period: float, seconds: float, priority: int) -> None:
        self._period = period
        self._process: subprocess.Popen[str] | None = None
        if shutil.which("cyclictest"):
            command = cyclictest.command(period, seconds, priority)
            self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def results(self) -> list[Lateness]:
        """Wait for the end of the round; empty if it is not installed; raises RuntimeError."""
        if self._process is None:
            return []
        output, _ = self._process.communicate()
        if self._process.returncode:
            raise RuntimeError(f"{self._process.args}: exit status {self._process.returncode}")
        late, worst = cyclictest.parse(output)
        return [msgspec.structs.replace(lateness("cyclictest", self._period, late), worst=worst)]

    def kill(self) -> None:
        """End the process early, if it is still running."""
        if self._process:
            self._process.kill()
