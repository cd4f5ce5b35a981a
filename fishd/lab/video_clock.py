"""Clock of a video against that of a recording, from the fin angle and the lateral force.

The force of a swinging tail gives its fin angle up to a scale and a drift (`camera.latency`). The
offset of the clocks is that at which this angle and that of the pictures agree best.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.camera.latency import JACKKNIFE_PARTS, STUDENT, Fit, Force, ForceAngle, leave_out_parts
from fishd.core.errors import FishdError

MIN_OVERLAP_S = 5.0
"""Shortest time that video and recording must have in common [s]."""
_PART_S = 60.0
"""Length of the part of the video whose times are compared [s]."""
_STEP_S = 0.01
_SMOOTH_S = 1.5
"""Time over which a moving mean is subtracted from both angles [s]."""
_RATES = np.geomspace(0.3, 30.0, 6)
"""K_d/K that are tried to find the offset roughly [1/s]."""
_MIN_AGREEMENT = 0.8
_RIVALS = 4
"""Number of further offsets that are compared with the best one."""
_MIN_DISTANCE_S = 0.1
"""Smallest distance of an offset that differs from the best one [s]."""
_RIVAL_MISFIT = 1.5
"""Misfit below which another offset fits as well, relative to that of the best one."""

Array = NDArray[np.float64]


class NoOffset(FishdError, ValueError):
    """The clocks of video and recording cannot be compared; the message says why."""


class ClockOffset(NamedTuple):
    """Offset of the clock of a recording from that of a video."""

    offset: float
    """Time of the recording minus time of the video, at `at` [s]."""
    ci95: float
    """Half-width of the 95 % interval of `offset`, from a jackknife [s]."""
    stretch: float
    """Time that passes in the recording for that in the video, minus 1."""
    stretch_ci95: float
    """Half-width of the 95 % interval of `stretch`."""
    at: float
    """Middle of the part of the video that was compared [s]."""
    agreement: float
    """Fraction of the variance of the fin angle that the pictures explain."""

    @property
    def begin(self) -> tuple[float, float]:
        """Time of the recording at the begin of the video, and half-width of its interval [s]."""
        error = math.hypot(self.ci95, self.stretch_ci95 * self.at)
        return self.offset - self.stretch * self.at, error

    def to_recording(self, times: Array) -> Array:
        """Return times on the clock of the recording for times of the video [s]."""
        return np.asarray(times + self.offset + self.stretch * (times - self.at))


def find_offset(times: Array, angles: Array, forces: Sequence[Force]) -> ClockOffset:
    """Return the offset of the clocks.

    times, angles: times of pictures and their fin angles, NaN where unknown [s, rad]
    forces: lateral forces of the recording, in order of time
    Raises `NoOffset`.
    """
    known = np.isfinite(angles)
    times, angles = times[known], angles[known]
    times, angles = _choose_part(times, angles)
    lateral = np.array([force.fy for force in forces])
    if not len(forces) or not float(np.ptp(lateral)) > 0.0:
        raise NoOffset("the recording has no lateral forces to compare the fin angle with")
    duration = min(forces[-1].end - forces[0].begin, times[-1] - times[0] if len(times) else 0.0)
    if duration < MIN_OVERLAP_S:
        raise NoOffset(
            f"{duration:.1f} s are too short to compare the clocks of video and recording; "
            f"{MIN_OVERLAP_S:g} s of swimming in both are needed"
        )
    guesses = _guess(times, angles, forces)
    refined = [_refine(times, angles, forces, *guess) for guess in guesses]
    fits = sorted(filter(None, refined), key=lambda fit: fit.misfit)
    if not fits or 1.0 - fits[0].misfit < _MIN_AGREEMENT:
        agreement = 1.0 - fits[0].misfit if fits else 0.0
        raise NoOffset(
            f"the fin angle and the forces of the recording agree by {max(0.0, agreement):.0%} "
            "only: is the recording of this swim, and does it overlap with the video?"
        )
    best = fits[0]
    for rival in fits[1:]:
        distance = abs(rival.offset - best.offset)
        if distance > _MIN_DISTANCE_S and rival.misfit < _RIVAL_MISFIT * best.misfit:
            raise NoOffset(
                f"the recording may begin {-best.offset:.2f} s or {-rival.offset:.2f} s after the "
                "video, because the swim repeats itself: let the fish start, stop or change its "
                "beat while both run"
            )
    return best.with_intervals()


class _Fit(NamedTuple):
    """Least-squares fit of offset, stretch and K_d/K."""

    offset: float
    misfit: float
    point: tuple[float, ...]
    """Delay [s], logarithm of K_d/K, stretch."""
    times: Array
    angles: Array
    angle: ForceAngle

    def with_intervals(self) -> ClockOffset:
        """Return the offset with its interval from a jackknife over parts of the pictures."""
        middle = 0.5 * float(self.times[0] + self.times[-1])
        points = []
        for kept in leave_out_parts(len(self.times)):
            point = Fit(self.angle, self.times[kept], self.angles[kept]).near(*self.point)
            centre = 0.5 * float(self.times[kept][0] + self.times[kept][-1])
            points.append((-point[0] + point[2] * (middle - centre), point[2]))
        errors = STUDENT * math.sqrt(JACKKNIFE_PARTS - 1) * np.std(points, axis=0)
        return ClockOffset(
            offset=self.offset,
            ci95=float(errors[0]),
            stretch=self.point[2],
            stretch_ci95=float(errors[1]),
            at=middle,
            agreement=1.0 - self.misfit,
        )


def _choose_part(times: Array, angles: Array) -> tuple[Array, Array]:
    """Return the part, not longer than `_PART_S`, whose swing changes most.

    A steady beat repeats itself and shows no offset; a start or stop does.
    """
    if not len(times) or times[-1] - times[0] <= _PART_S:
        return times, angles
    swing = (angles - angles.mean()) ** 2
    swing -= _without_drift(swing, float(np.median(np.diff(times))))
    moments = [np.concatenate([[0.0], np.cumsum(swing**power)]) for power in (1, 2)]
    ends = np.searchsorted(times, np.minimum(times + _PART_S, times[-1]))
    count = np.maximum(ends - np.arange(len(times)), 1)
    mean, square = ((moment[ends] - moment[:-1]) / count for moment in moments)
    begin = int(np.argmax((square - mean**2) * (times <= times[-1] - _PART_S)))
    return times[begin : ends[begin]], angles[begin : ends[begin]]


def _guess(times: Array, angles: Array, forces: Sequence[Force]) -> list[tuple[float, float]]:
    """Return offsets [s] with logarithms of K_d/K at which the angles are most alike."""
    angle = ForceAngle(forces)
    fine = np.arange(angle.first, angle.last, _STEP_S)
    grid = np.arange(times[0], times[-1], _STEP_S)
    seen = _without_drift(np.interp(grid, times, angles))
    size = 2 ** (len(fine) + len(grid)).bit_length()
    # A cross-correlation by spectra; index k is the place of the video's begin in the recording.
    spectrum = np.fft.rfft(seen, size).conj()
    covered = np.fft.rfft(np.ones(len(grid)), size).conj()
    squares = np.fft.rfft(seen**2, size).conj()
    inside = np.fft.irfft(np.fft.rfft(np.ones(len(fine)), size) * squares, size)
    best, log_rate = np.zeros(size), 0.0
    for rate in _RATES:
        felt = _without_drift(angle.at(fine, float(rate)))
        both = np.fft.irfft(np.fft.rfft(felt, size) * spectrum, size)
        energy = np.fft.irfft(np.fft.rfft(felt**2, size) * covered, size)
        # A part of either that hardly swings shows nothing.
        least = 0.25 * min(inside.max(), seen @ seen), 0.05 * energy.max()
        alike = np.where(
            (inside > least[0]) & (energy > least[1]),
            both**2 / np.maximum(inside * energy, 1e-300),
            0.0,
        )
        if alike.max() > best.max():
            best, log_rate = alike, math.log(rate)
    lags = np.arange(size)
    lags[lags > len(fine)] -= size
    guesses: list[tuple[float, float]] = []
    for index in np.argsort(best)[::-1]:
        offset = angle.first + _STEP_S * float(lags[index]) - float(times[0])
        if best[index] <= 0.0 or len(guesses) > _RIVALS:
            break
        if all(abs(offset - other) > _MIN_DISTANCE_S for other, _ in guesses):
            guesses.append((offset, log_rate))
    return guesses


def _without_drift(values: Array, step: float = _STEP_S) -> Array:
    """Return values minus their moving mean; step: time between two of them [s]."""
    width = max(1, min(round(_SMOOTH_S / step), len(values) - 1)) | 1
    total = np.cumsum(np.pad(values, (width // 2 + 1, width // 2), mode="edge"))
    return np.asarray(values - (total[width:] - total[:-width]) / width)


def _refine(
    times: Array, angles: Array, forces: Sequence[Force], offset: float, log_rate: float
) -> _Fit | None:
    """Return the best fit near an offset; None where video and recording hardly overlap."""
    first, last = times[0] + offset, times[-1] + offset
    near = [force for force in forces if first - 5.0 < force.end < last + 1.0]
    if len(near) < 2:
        return None
    angle = ForceAngle(near)
    inside = (times + offset > angle.first + 0.2) & (times + offset < angle.last - 0.2)
    if (
        np.count_nonzero(inside) < 4 * JACKKNIFE_PARTS
        or np.ptp(times[inside]) < MIN_OVERLAP_S - 0.5
    ):
        return None
    kept = times[inside], angles[inside]
    fit = Fit(angle, *kept)
    point = fit.near(-offset, log_rate, 0.0)
    return _Fit(-point[0], fit.misfit(*point), point, *kept, angle)
