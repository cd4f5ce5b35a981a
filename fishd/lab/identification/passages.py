"""Recorded ticks as passages without a gap, of which each can be simulated from its start."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fishd.core.errors import FishdError
from fishd.lab.identification.response import Array

if TYPE_CHECKING:
    from pandas import DataFrame

COLUMNS = ("t", "seq", "missed", "fx", "fy", "phi_c", "servo_on", "samples")
"""What is read of a table of ticks."""
SHORTEST = 5.0
"""Shorter passages tell little beyond how they began [s]."""
_LONGEST_WINDOW = 20
"""More slots than this at once is a suspended machine [slots]."""


class Unidentifiable(FishdError, ValueError):
    """These ticks do not tell what the fish is; the message says what is missing."""


@dataclass(frozen=True)
class Passage:
    """Ticks without a gap, in which the servo had pulses and the sensor answered."""

    tick: float
    """Period of the loop [s]."""
    samples: int
    """Samples of the force in each period."""
    commands: Array
    """φ_c in each slot of one period [rad], shape (slots,)."""
    ends: NDArray[np.int_]
    """Slots at whose starts windows begin and end, shape (windows + 1,)."""
    forces: Array
    """Mean F_x and F_y of each window as measured [N], shape (2, windows)."""
    times: Array
    """When each window ended, since the first tick of all [s], shape (windows,)."""

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self.ends[-1] * self.tick)


def passages(tables: "Sequence[DataFrame]") -> list[Passage]:
    """The passages of some runs, in order.

    Raises `Unidentifiable` where there are none, or columns are missing.
    """
    found = []
    begin = 0.0
    for table in tables:
        missing = [name for name in COLUMNS if name not in table]
        if missing:
            raise Unidentifiable(
                f"no table of ticks: the column {missing[0]} is missing; {', '.join(COLUMNS)} are "
                "needed"
            )
        if len(table) < 2:
            continue
        columns = {name: table[name].to_numpy() for name in COLUMNS}
        if "suspect" in table:  # a force that is not to be believed is none
            columns["samples"] = np.where(table["suspect"].fillna("") == "", columns["samples"], 0)
        tick = _period(columns)
        for rows in _unbroken(columns):
            passage = _passage(columns, rows, tick, begin)
            if passage.duration >= SHORTEST:
                found.append(passage)
        begin += float(columns["t"][-1] - columns["t"][0])
    if not found:
        raise Unidentifiable(
            f"there is no passage of {SHORTEST:g} s without a gap in which the servo has pulses; "
            "a recording of a fish that swims is needed"
        )
    return found


def _period(columns: dict[str, Array]) -> float:
    """The period of the loop, from the times of ticks, which a busy machine stamps late [s]."""
    slots = np.diff(columns["seq"]) + np.diff(columns["missed"])
    good = slots > 0
    each = np.diff(columns["t"])[good] / slots[good]
    if not len(each) or not (median := float(np.median(each))) > 0.0:
        raise Unidentifiable("the times of these ticks do not increase: this is no run of a fish")
    # What one tick is late, the next one is early: the mean is good where clocks do not jump.
    mean = float(np.mean(each[np.abs(each - median) < 0.5 * median]))
    rounded = float(f"{mean:.3g}")
    return rounded if abs(rounded - mean) < 2e-3 * mean else mean


def _unbroken(columns: dict[str, Array]) -> Iterator[slice]:
    """Rows between which nothing is missing, and that can be used."""
    usable = (
        columns["servo_on"].astype(bool)
        & (columns["samples"] > 0)
        & np.isfinite(columns["fx"] + columns["fy"] + columns["phi_c"])
    )
    slots = 1 + np.diff(columns["missed"])
    follows = (np.diff(columns["seq"]) == 1) & (slots >= 1) & (slots <= _LONGEST_WINDOW)
    joined = np.concatenate(([False], follows & usable[1:] & usable[:-1]))
    starts = np.flatnonzero(~joined)
    for start, stop in zip(starts, [*starts[1:], len(joined)], strict=True):
        if stop - start > 1:
            yield slice(int(start), int(stop))


def _passage(columns: dict[str, Array], rows: slice, tick: float, begin: float) -> Passage:
    slots = 1 + np.diff(columns["missed"][rows]).astype(int)
    phi_c = columns["phi_c"][rows].astype(float)
    # The command of a tick acts until the next one; the forces of a tick are those before it.
    commands = np.repeat(phi_c[:-1], slots)
    forces = np.stack((columns["fx"][rows], columns["fy"][rows])).astype(float)[:, 1:]
    times = begin + (columns["t"][rows][1:] - columns["t"][0]).astype(float)
    return Passage(
        tick=tick,
        samples=max(1, round(float(np.median(columns["samples"][rows][1:] / slots)))),
        commands=commands,
        ends=np.concatenate(([0], np.cumsum(slots))),
        forces=forces,
        times=times,
    )
