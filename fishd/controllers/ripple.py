"""The ripple of F_x: how much of it comes twice, four and six times a beat."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

SPIKE = 6.0
"""A force is a spike if it is so many times further from what is usual than half of the others."""
LARGE_SPIKE = 2.0
"""And a spike for the mean of F_x, too, beyond so many standard deviations of F_x."""


def ripples(halves: list[list[tuple[float, float]]]) -> tuple[list[float], list[float]]:
    """Return mean squares of the ripple [N²] and means [N] of F_x.

    There is one of each for each two half beats that follow one another.

    halves: F_x and F_y of each tick, from reversal to reversal [N]; two of them or more
    """
    forces = _without_lateral_force(halves)
    squares = [_square(np.concatenate(beat)) for beat in pairwise(_without_spikes(forces, 0.0))]
    # Of halves that differ in length, what is far from usual may be thrust.
    certain = LARGE_SPIKE * float(np.concatenate(forces).std())
    cleaned = _without_spikes(forces, certain)
    return squares, [float(np.concatenate(beat).mean()) for beat in pairwise(cleaned)]


def _without_lateral_force(halves: list[list[tuple[float, float]]]) -> list[NDArray[np.float64]]:
    """F_x without what a turned sensor mixes in of F_y: the slope of the one on the other [N]."""
    fx, fy = np.array([forces for half in halves for forces in half]).T
    level = fy - fy.mean()
    spread = level @ level
    if spread:
        fx = fx - level * (level @ fx) / spread
    return np.split(fx, np.cumsum([len(half) for half in halves])[:-1])


def _without_spikes(
    halves: list[NDArray[np.float64]], smallest: float
) -> list[NDArray[np.float64]]:
    """With what is usual so long after a reversal, where a force is far from that [N].

    smallest: what is nearer is not a spike [N]
    """
    lengths = np.array([len(half) for half in halves])
    table = np.full((len(halves), lengths.max()), np.nan)  # a row for each half beat
    there = np.arange(lengths.max()) < lengths[:, None]
    table[there] = np.concatenate(halves)
    # Medians of columns that differ in length; `sort` puts what is not there last.
    inner = (there.sum(axis=0) - 1) / 2
    ordered, columns = np.sort(table, axis=0), np.arange(lengths.max())
    low, high = np.floor(inner).astype(int), np.ceil(inner).astype(int)
    usual = 0.5 * (ordered[low, columns] + ordered[high, columns])
    distance = np.abs(table - usual)
    limit = max(smallest, SPIKE * float(np.median(distance[there])))
    cleaned = np.where(distance > limit, usual, table)
    return [row[:length] for row, length in zip(cleaned, lengths, strict=True)]


def _square(beat: NDArray[np.float64]) -> float:
    """Mean square of what comes twice a beat, four times and six times [N²]."""
    twice = np.abs(np.fft.rfft(beat)[2:7:2] / len(beat)) ** 2
    if len(beat) in (4, 8, 12):
        twice[-1] *= 0.5  # of the highest frequency there is one term only
    return 2.0 * float(twice.sum())
