"""The delay of a camera's whole path, measured against the lateral force of the fish it looks at.

The force of a swinging tail is F_y = −K α̈ − K_d α̇. Integrated twice it gives the fin angle up to
its scale, a drift, and one unknown rate K_d/K; the pictures show the same angle. The delay is that
by which the two agree best. Neither K nor K_d nor the geometry of the camera is needed.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.camera.tail import find_tails
from fishd.core.camera_frames import Frame
from fishd.core.errors import FishdError

Floats = NDArray[np.float64]

LATEST, EARLIEST = 0.5, -0.1
"""Delays that are looked for [s]."""
SHORTEST = 10.0
"""Less swimming tells too little [s]."""
PARTS = 12
"""The jackknife leaves out one of so many parts of the swim."""
_STUDENT = 2.201
"""97.5 % quantile of Student's t with `PARTS` - 1 degrees of freedom."""
_SLOWEST = 0.35
"""What is slower is drift of the sensor, not swimming [Hz]."""
_STEP = 5e-3
"""Of the integration [s]."""
_RATES = (0.3, 30.0)
"""K_d/K is looked for between these [1/s]."""
_ENOUGH = 0.8
"""Pictures and forces that agree less are not those of one tail."""


class NoDelay(FishdError, ValueError):
    """The delay cannot be told from these pictures and forces; the message says why."""


class Force(NamedTuple):
    """The lateral force of one tick."""

    begin: float
    """Begin of the window that it is the mean of [s, clock of fishd]."""
    end: float
    fy: float
    """[N]"""


class Latency(NamedTuple):
    """How old pictures are."""

    stamps: float
    """So much later than the middle of its exposure is the time of a frame [s]."""
    error: float
    """Half of the 95 % interval of that, by a jackknife over parts of the swim [s]."""
    arrival: float
    """From the time of a frame until it could be had, mean [s]."""
    latest: float
    """The same, exceeded by one in a hundred [s]."""
    agreement: float
    """Share of the force's motion that the pictures show, 0 to 1."""
    frames: int
    """How many were used."""

    @property
    def whole(self) -> float:
        """From the middle of the exposure until the frame could be had, mean [s]."""
        return self.stamps + self.arrival


def find_latency(frames: Sequence[Frame], forces: Sequence[Force]) -> Latency:
    """The delay in a swim with many frequencies in it; frames and forces in order of time.

    Raises `NoMotion`, and `NoDelay` where frames or forces are too few, or do not agree.
    """
    if not forces or forces[-1].end - forces[0].begin < SHORTEST:
        raise NoDelay(f"{SHORTEST:g} s of swimming are needed to tell a delay")
    angle = _Angle(forces)
    inside = [
        frame for frame in frames if angle.first + LATEST < frame.time < angle.last + EARLIEST
    ]
    if len(inside) < 100:
        raise NoDelay(f"{len(inside)} frames are too few to tell a delay; 100 are needed")
    times = np.array([frame.time for frame in inside])
    position = find_tails(np.stack([frame.pixels for frame in inside])).positions
    position /= position.std()
    fit = _Fit(angle, times, position)
    delay, log_rate = fit.best()
    agreement = 1.0 - fit.misfit(delay, log_rate)
    if agreement < _ENOUGH:
        raise NoDelay(
            f"pictures and forces agree by {max(0.0, agreement):.0%} only: is it the same fish, "
            "and does the camera see its whole tail?"
        )
    left_out = [
        _Fit(angle, times[kept], position[kept]).near(delay, log_rate)[0]
        for kept in _all_but_one_part(len(times))
    ]
    error = _STUDENT * math.sqrt((PARTS - 1) * float(np.var(left_out)))
    late = [frame.available - frame.time for frame in inside]
    return Latency(
        stamps=delay,
        error=error,
        arrival=float(np.mean(late)),
        latest=float(np.quantile(late, 0.99)),
        agreement=agreement,
        frames=len(inside),
    )


def _all_but_one_part(number: int) -> list[NDArray[np.bool_]]:
    part = np.arange(number) * PARTS // number
    return [part != left_out for left_out in range(PARTS)]


class _Angle:
    """The fin angle that forces tell of, up to its scale and a drift."""

    def __init__(self, forces: Sequence[Force]) -> None:
        ends = np.array([force.end for force in forces])
        fy = np.array([force.fy for force in forces])
        fy -= fy.mean()
        edges = np.concatenate(([forces[0].begin], ends))
        impulse = np.concatenate(([0.0], np.cumsum(fy * np.diff(edges))))
        self.first, self.last = float(edges[0]), float(edges[-1])
        self._fine = np.arange(self.first, self.last, _STEP)
        self._impulse = -_smooth(self._fine, edges, impulse)
        # A power of two is the quickest; of twice the length, so that nothing comes round again.
        self._size = 2 ** (2 * len(self._fine) - 1).bit_length()
        self._spectrum = np.fft.rfft(self._impulse, self._size)
        self._kept: dict[float, Floats] = {}

    def at(self, times: Floats, rate: float) -> Floats:
        """α · K where K_d/K is `rate` [1/s]: the solution of α̇ + rate · α = −(∫ F_y dt)/K."""
        course = self._kept.get(rate)
        if course is None:
            kernel = np.exp(-rate * _STEP * np.arange(len(self._fine)))
            spectrum = self._spectrum * np.fft.rfft(kernel, self._size)
            course = np.fft.irfft(spectrum, self._size)[: len(self._fine)] * _STEP
            # Each step holds half of what is added at its own point.
            course -= 0.5 * _STEP * self._impulse
            self._kept = {rate: course}
        return np.asarray(np.interp(times, self._fine, course))


class _Fit:
    """How well pictures agree with forces, for any delay and any rate K_d/K."""

    def __init__(self, angle: _Angle, times: Floats, position: Floats) -> None:
        self._angle, self._times = angle, times
        span = times[-1] - times[0]
        along = (times - times[0]) / span
        slow = [np.cos(math.pi * k * along) for k in range(int(2 * _SLOWEST * span) + 1)]
        self._drift = np.linalg.qr(np.stack([*slow, along, along**2, along**3], axis=1))[0]
        seen = np.stack([position, position**3], axis=1)
        self._seen = np.linalg.qr(_without(self._drift, seen))[0]

    def misfit(self, delay: float, log_rate: float) -> float:
        """Share of the angle's variance that the pictures do not show."""
        residual = self._residual(delay, log_rate)
        return float(residual @ residual)

    def best(self) -> tuple[float, float]:
        """Delay [s] and logarithm of the rate of the best agreement."""
        grid = [
            (float(delay), float(log_rate))
            for log_rate in np.linspace(math.log(_RATES[0]), math.log(_RATES[1]), 10)
            for delay in np.arange(EARLIEST, LATEST, 0.02)
        ]
        return self.near(*min(grid, key=lambda point: self.misfit(*point)))

    def near(self, delay: float, log_rate: float) -> tuple[float, float]:
        """The same from a point close to it: Levenberg and Marquardt's method."""
        point, damping = np.array([delay, log_rate]), 1e-3
        residual = self._residual(*point)
        for _ in range(40):
            slopes = np.stack(
                [(self._residual(*(point + step)) - residual) / step.sum() for step in _PROBES],
                axis=1,
            )
            normal = slopes.T @ slopes
            damped = normal + damping * np.diag(np.diag(normal))
            move = np.linalg.lstsq(damped, -slopes.T @ residual, rcond=None)[0]
            tried = self._residual(*(point + move))
            if not tried @ tried < residual @ residual:
                damping *= 10.0
                if damping > 1e6:
                    break
                continue
            point, residual, damping = point + move, tried, 0.1 * damping
            if abs(move[0]) < 1e-6:
                break
        return float(point[0]), float(point[1])

    def _residual(self, delay: float, log_rate: float) -> Floats:
        angle = _without(self._drift, self._angle.at(self._times - delay, math.exp(log_rate)))
        angle /= np.linalg.norm(angle)
        return _without(self._seen, angle)


_PROBES = np.diag([1e-4, 1e-3])
"""Steps of delay [s] and logarithm of the rate by which slopes are found."""


def _without(basis: Floats, values: Floats) -> Floats:
    """What is left of values once their part in an orthonormal basis is taken off."""
    return np.asarray(values - basis @ (basis.T @ values))


def _smooth(at: Floats, x: Floats, y: Floats) -> Floats:
    """The cubic spline through points of about even distance, as Catmull and Rom have it."""
    slopes = np.gradient(y, x)
    index = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    h = x[index + 1] - x[index]
    s = (at - x[index]) / h
    left, right = slopes[index] * h, slopes[index + 1] * h
    rise = y[index + 1] - y[index]
    square, cube = 3.0 * rise - 2.0 * left - right, left + right - 2.0 * rise
    return np.asarray(y[index] + s * (left + s * (square + s * cube)))
