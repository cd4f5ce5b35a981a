"""Passages: recorded ticks without a gap, each of which can be simulated from its start."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fishd.config import ServoSettings
from fishd.core.errors import FishdError
from fishd.lab.identification.response import Array, Timing, even_timing

if TYPE_CHECKING:
    from pandas import DataFrame

COLUMNS = ("time", "seq", "missed_slots", "fx", "fy", "phi_c", "servo_on", "samples")
"""Columns of a table of ticks that an identification reads."""
_AGES = ("force_age_ms", "force_span_ms")
"""Columns that say when the force was sampled; they are not in tables of other rigs."""
_MAX_SPAN_ERROR_MS, _MAX_AGE_MS = 1.0, 500.0
"""Largest time by which samples may seem to be later than their tick, and earlier [ms]."""
_MAX_SAMPLES = 40
"""Largest number of samples in a period; more would not change the mean force."""
MIN_PASSAGE_S = 5.0
"""Length of the shortest passage that is used [s]."""
_MAX_WINDOW_SLOTS = 20
"""Largest number of periods in one window; a longer window means that the machine was suspended."""


class Unidentifiable(FishdError, ValueError):
    """The ticks do not suffice for an identification; the message says what is missing."""


@dataclass(frozen=True)
class Passage:
    """Ticks without a gap, in which the servo had pulses and the sensor answered."""

    tick: float
    """Period of the loop [s]."""
    timing: Timing
    """Times of commands and samples."""
    commands: Array
    """φ_c in each slot of one period [rad], shape (slots,)."""
    ends: NDArray[np.int_]
    """Slots at whose starts windows begin and end, shape (windows + 1,)."""
    forces: Array
    """Mean F_x and F_y of each window as measured [N], shape (2, windows)."""
    times: Array
    """End of each window, as time since the first tick of all [s], shape (windows,)."""
    servo: ServoSettings | None
    """Calibrated settings of the servo; None if no pulses carry its commands."""
    angles: Array
    """Angles that the pulses stand for, in each slot [rad], shape (slots,)."""

    @property
    def duration(self) -> float:
        """Length of the passage [s]."""
        return float(self.ends[-1] * self.tick)


def passages(
    tables: "Sequence[DataFrame]", servos: Sequence[ServoSettings | None] = ()
) -> list[Passage]:
    """Return the passages of runs, in order.

    servos: calibrated settings of the servo of each run; None, the default, for no pulses
    Raises `Unidentifiable` where no passage is long enough, or a column is missing.
    """
    usable = []
    begin = 0.0
    for table, servo in zip_longest(tables, servos):
        missing = [name for name in COLUMNS if name not in table]
        if missing:
            raise Unidentifiable(
                f"not a table of ticks: the column {missing[0]} is missing; {', '.join(COLUMNS)} "
                "are needed"
            )
        if len(table) < 2:
            continue
        ages = _AGES if all(name in table for name in _AGES) else ()
        columns = {name: _numbers(table, name) for name in (*COLUMNS, *ages)}
        if "elapsed" in table:  # of a recording: it increases across restarts of fishd, too
            columns["time"] = table["elapsed"].to_numpy()
        if "suspect" in table:  # a suspect force counts as missing
            columns["samples"] = np.where(table["suspect"].fillna("") == "", columns["samples"], 0)
        tick = _period(columns)
        for rows in _unbroken_rows(columns):
            passage = _passage(columns, rows, tick, begin, servo)
            if passage.duration >= MIN_PASSAGE_S:
                usable.append(passage)
        begin += float(columns["time"][-1] - columns["time"][0])
    if not usable:
        raise Unidentifiable(
            f"there is no passage of {MIN_PASSAGE_S:g} s without a gap in which the servo has "
            "pulses and F_x and F_y are trusted; a recording of a fish that swims is needed"
        )
    return usable


def _numbers(table: "DataFrame", name: str) -> Array:
    """Return a column; raise `Unidentifiable` if it does not contain numbers."""
    try:
        return table[name].to_numpy(dtype=float)
    except (TypeError, ValueError):
        raise Unidentifiable(f"not a table of ticks: the column {name} has no numbers") from None


def _period(columns: dict[str, Array]) -> float:
    """Return the period of the loop [s], from times of ticks, some of which are late."""
    slots = np.diff(columns["seq"]) + np.diff(columns["missed_slots"])
    good = slots > 0
    intervals = np.diff(columns["time"])[good] / slots[good]
    if not len(intervals) or not (median := float(np.median(intervals))) > 0.0:
        raise Unidentifiable("the times of the ticks do not increase: use a recording of a fish")
    # A late tick shortens the next interval: the mean is right where clocks do not jump.
    mean = float(np.mean(intervals[np.abs(intervals - median) < 0.5 * median]))
    rounded = float(f"{mean:.3g}")
    return rounded if abs(rounded - mean) < 2e-3 * mean else mean


def _unbroken_rows(columns: dict[str, Array]) -> Iterator[slice]:
    """Yield slices of usable rows without a gap."""
    usable = (
        columns["servo_on"].astype(bool)
        & (columns["samples"] > 0)
        & np.isfinite(columns["fx"] + columns["fy"] + columns["phi_c"])
    )
    slots = 1 + np.diff(columns["missed_slots"])
    follows = (np.diff(columns["seq"]) == 1) & (slots >= 1) & (slots <= _MAX_WINDOW_SLOTS)
    joined = np.concatenate(([False], follows & usable[1:] & usable[:-1]))
    starts = np.flatnonzero(~joined)
    for start, stop in zip(starts, [*starts[1:], len(joined)], strict=True):
        if stop - start > 1:
            yield slice(int(start), int(stop))


def _passage(
    columns: dict[str, Array], rows: slice, tick: float, begin: float, servo: ServoSettings | None
) -> Passage:
    """Return the passage of these rows; begin: time of the first tick of the table [s]."""
    slots = 1 + np.diff(columns["missed_slots"][rows]).astype(int)
    phi_c = columns["phi_c"][rows].astype(float)
    # The command of a tick applies until the next one; its forces are means since the last one.
    commands = np.repeat(phi_c[:-1], slots)
    forces = np.stack((columns["fx"][rows], columns["fy"][rows])).astype(float)[:, 1:]
    times = begin + (columns["time"][rows][1:] - columns["time"][0]).astype(float)
    ends = np.concatenate(([0], np.cumsum(slots)))
    samples = max(1, round(float(np.median(columns["samples"][rows][1:] / slots))))
    timing = even_timing(ends, tick, min(samples, _MAX_SAMPLES))
    if _AGES[0] in columns:
        timing = _with_spans(timing, *(columns[name][rows][1:].astype(float) for name in _AGES))
    return Passage(
        tick=tick,
        timing=timing,
        commands=commands,
        ends=ends,
        forces=forces,
        times=times,
        servo=servo,
        angles=commands,
    )


def _with_spans(timing: Timing, age_ms: Array, span_ms: Array) -> Timing:
    """Return a timing with the true spans of samples, where they are known.

    age_ms: mean age of the samples of each window at its end; span_ms: length of their span
    Raises `Unidentifiable` for spans in the future or long ago.
    """
    known = np.isfinite(age_ms) & np.isfinite(span_ms) & (span_ms > 0.0)
    latest, oldest = age_ms - 0.5 * span_ms, age_ms + 0.5 * span_ms
    wrong = known & ((latest < -_MAX_SPAN_ERROR_MS) | (oldest > _MAX_AGE_MS))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise Unidentifiable(
            f"force_age_ms is {age_ms[first]:g} and force_span_ms {span_ms[first]:g} somewhere: "
            f"samples of the {_MAX_AGE_MS:g} ms before a tick are needed; without these columns, "
            "samples all over each tick are assumed"
        )
    middles, halves = timing.spans[1] - 1e-3 * age_ms, 0.5e-3 * span_ms
    spans = np.stack((middles - halves, middles + halves))
    return replace(timing, spans=np.where(known, spans, timing.spans))
