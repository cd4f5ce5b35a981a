"""Ripple of F_x: its components at two, four and six times the beat frequency."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

SPIKE_RATIO = 6.0
"""Ratio of a force's deviation from the usual force to the median deviation that makes a spike."""
LARGE_SPIKE_DEVIATIONS = 2.0
"""Number of standard deviations of F_x that a spike must exceed, too, for the mean of F_x."""


def compute_ripples(
    halves: list[list[tuple[float, float]]],
) -> tuple[list[float], list[float], list[float]]:
    """Return mean squares of the ripple and of the noise in it [N²], and means of F_x [N].

    Each list has one value for each two half beats.

    halves: F_x and F_y of each tick of two or more half beats, from reversal to reversal [N]
    """
    forces = _remove_lateral_force(halves)
    powers = [
        _ripple_power(np.concatenate(beat)) for beat in pairwise(_replace_spikes(forces, 0.0))
    ]
    squares, noises = map(list, zip(*powers, strict=True))
    # In half beats of different length, a large deviation may be thrust.
    large_spike = LARGE_SPIKE_DEVIATIONS * float(np.concatenate(forces).std())
    cleaned = _replace_spikes(forces, large_spike)
    return squares, noises, [float(np.concatenate(beat).mean()) for beat in pairwise(cleaned)]


def _remove_lateral_force(halves: list[list[tuple[float, float]]]) -> list[NDArray[np.float64]]:
    """Return F_x without the part of F_y that a turned sensor adds, by linear regression [N]."""
    fx, fy = np.array([forces for half in halves for forces in half]).T
    level = fy - fy.mean()
    spread = level @ level
    if spread:
        fx = fx - level * (level @ fx) / spread
    return np.split(fx, np.cumsum([len(half) for half in halves])[:-1])


def _replace_spikes(
    halves: list[NDArray[np.float64]], smallest: float
) -> list[NDArray[np.float64]]:
    """Replace spikes by the median force at the same time after a reversal [N].

    smallest: smallest deviation of a spike [N]
    """
    lengths = np.array([len(half) for half in halves])
    table = np.full((len(halves), lengths.max()), np.nan)  # one row per half beat
    is_present = np.arange(lengths.max()) < lengths[:, None]
    table[is_present] = np.concatenate(halves)
    # Medians of columns of different length; `sort` puts missing values (NaN) last.
    inner = (is_present.sum(axis=0) - 1) / 2
    ordered, columns = np.sort(table, axis=0), np.arange(lengths.max())
    low, high = np.floor(inner).astype(int), np.ceil(inner).astype(int)
    median = 0.5 * (ordered[low, columns] + ordered[high, columns])
    distance = np.abs(table - median)
    limit = max(smallest, SPIKE_RATIO * float(np.median(distance[is_present])))
    cleaned = np.where(distance > limit, median, table)
    return [row[:length] for row, length in zip(cleaned, lengths, strict=True)]


def _ripple_power(beat: NDArray[np.float64]) -> tuple[float, float]:
    """Return the mean square of the components at 2, 4 and 6 times the beat frequency [N²].

    The second value is the part of it that is noise, from the components in between: an equal
    beat to either side has no thrust there.
    """
    powers = 2.0 * np.abs(np.fft.rfft(beat) / len(beat)) ** 2
    if len(beat) % 2 == 0:
        powers[-1] *= 0.5  # the highest frequency has only one term
    ripple, between = powers[2:7:2], powers[3:8:2]
    noise = between.mean() if len(between) else 0.0
    return float(ripple.sum()), float(noise * len(ripple))
