"""Timing statistics of the loop, in constant memory however long it runs."""

from bisect import bisect_left
from itertools import accumulate, pairwise

from fishd.core.signals import Percentiles, Timing

_OCTAVE_BITS = 3  # 2**3 buckets per octave: an error of at most 12 %
_MAX_NS = (1 << 40) - 1  # 18 minutes; a longer duration counts as this
_MAX_S = _MAX_NS * 1e-9

PHASES = ("read", "estimate", "update", "write", "publish")


class Histogram:
    """Counts of durations in buckets whose width grows with the duration; the worst is exact."""

    def __init__(self) -> None:
        self._counts = [0] * (_MAX_NS.bit_length() << _OCTAVE_BITS)
        self._total = 0
        self._worst = 0.0
        self._worst_seq = 0

    def add(self, seconds: float, seq: int) -> None:
        """Count a duration [s] that was measured in tick `seq`; a negative one counts as zero."""
        self._total += 1
        if seconds <= 0.0:
            self._counts[0] += 1
            return
        nanoseconds = int(seconds * 1e9) if seconds < _MAX_S else _MAX_NS
        octave = nanoseconds.bit_length() - _OCTAVE_BITS - 1
        if octave < 0:
            octave = 0
        self._counts[(octave << _OCTAVE_BITS) + (nanoseconds >> octave)] += 1
        if seconds > self._worst:
            self._worst = seconds
            self._worst_seq = seq

    def quantile(self, share: float) -> float:
        """Return the duration that a fraction `share` of all do not exceed [s]; 0 without data."""
        if not self._total:
            return 0.0
        bucket = bisect_left(list(accumulate(self._counts)), share * self._total)
        return min(_upper_edge(bucket), self._worst)

    def percentiles(self) -> Percentiles:
        """Return median, 99th percentile and worst duration [µs]."""
        return Percentiles(
            p50=self.quantile(0.50) * 1e6,
            p99=self.quantile(0.99) * 1e6,
            max=self._worst * 1e6,
            max_seq=self._worst_seq,
        )


def _upper_edge(bucket: int) -> float:
    """Return the longest duration of a bucket [s]."""
    octave = max(0, (bucket >> _OCTAVE_BITS) - 1)
    return (((bucket - (octave << _OCTAVE_BITS)) + 1 << octave) - 1) * 1e-9


class Statistics:
    """Lateness, time per phase, missed slots and overruns since start."""

    def __init__(self, period: float) -> None:
        """period: period of the loop [s]"""
        self.missed = 0
        self.overruns = 0
        self._period = period
        self._overran = False
        self._lateness = Histogram()
        self._busy = Histogram()
        self._phases = tuple(Histogram() for _ in PHASES)

    def add(self, seq: int, lateness: float, missed: int, marks: tuple[float, ...]) -> str | None:
        """Count one tick, and return a line if it took too long or slots were skipped; else None.

        Slots skipped because the tick before took too long give no second line.

        lateness: start of the tick after its deadline [s]
        missed: number of slots skipped just before the tick
        marks: times at the start of the tick and after each of PHASES [s]
        """
        busy = marks[-1] - marks[0]
        if busy or lateness:  # both are 0 in virtual time, where nothing is to be counted
            self._count(seq, lateness, marks)
        message = None
        if busy > self._period:
            self.overruns += 1
            message = self._why_long(seq, marks)
        elif missed and not self._overran:
            message = (
                f"{missed} slots were skipped before tick {seq}: fishd was woken late, "
                "the machine is overloaded or was suspended"
            )
        self._overran = message is not None
        return message

    def _count(self, seq: int, lateness: float, marks: tuple[float, ...]) -> None:
        self._lateness.add(lateness, seq)
        before = marks[0]
        for histogram, mark in zip(self._phases, marks[1:], strict=True):
            histogram.add(mark - before, seq)
            before = mark
        self._busy.add(before - marks[0], seq)

    def _why_long(self, seq: int, marks: tuple[float, ...]) -> str:
        """Return one line that blames the longest phase of a tick that took too long."""
        durations = (after - before for before, after in pairwise(marks))
        longest, phase = max(zip(durations, PHASES, strict=True))
        return (
            f"tick {seq} took {(marks[-1] - marks[0]) * 1e3:.1f} ms of its "
            f"{self._period * 1e3:g} ms, {longest * 1e3:.1f} ms of it in {phase}"
        )

    def timing(self) -> Timing:
        """Return the distributions since start."""
        return Timing(
            lateness=self._lateness.percentiles(),
            duration=self._busy.percentiles(),
            phases={
                name: histogram.percentiles()
                for name, histogram in zip(PHASES, self._phases, strict=True)
            },
        )
