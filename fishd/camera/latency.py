"""Delay of a camera's whole path, measured against the lateral force of the fish.

The force of a swinging tail is F_y = −K α̈ − K_d α̇. Integrated twice, it gives the fin angle up to
a scale, a drift, and one unknown rate K_d/K; the pictures show the same angle. The estimate is the
delay at which the two agree best. It needs neither K nor K_d nor the geometry of the camera.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import Floats, find_motion
from fishd.core.camera_frames import Frame
from fishd.core.errors import FishdError

MAX_DELAY_S, MIN_DELAY_S = 0.5, -0.1
"""Largest and smallest delay that is searched [s]."""
MIN_SWIM_S = 10.0
"""Shortest swim from which the delay is estimated [s]."""
JACKKNIFE_PARTS = 12
"""Number of parts of the swim; the jackknife leaves out one of them at a time."""
STUDENT = 2.201
"""97.5 % quantile of Student's t with `JACKKNIFE_PARTS` - 1 degrees of freedom."""
_MIN_FREQUENCY_HZ = 0.35
"""Lowest frequency of swimming; slower changes are drift of the sensor [Hz]."""
_STEP_S = 5e-3
"""Step of the integration [s]."""
_RATE_RANGE = (0.3, 30.0)
"""Range in which K_d/K is searched [1/s]."""
_TAIL_THRESHOLD = 0.25
"""Difference from the median picture above which a pixel shows the tail, as a fraction of the 99 %
quantile of the differences."""
_MOTION_THRESHOLD = 0.05
"""Energy above which a pixel belongs to the motion, as a fraction of the largest energy."""
_MIN_AGREEMENT = 0.8
"""Smallest agreement of pictures and forces that belong to the same tail."""


class NoDelay(FishdError, ValueError):
    """The delay cannot be estimated from these pictures and forces; the message says why."""


class Force(NamedTuple):
    """Lateral force of one tick."""

    begin: float
    """Begin of the window over which the force is averaged [s, clock of fishd]."""
    end: float
    """End of the window [s, clock of fishd]."""
    fy: float
    """Mean lateral force [N]."""


class Latency(NamedTuple):
    """Latency of a camera's frames."""

    stamps: float
    """Delay of a frame's time stamp after the middle of its exposure [s]."""
    ci95: float
    """Half-width of the 95 % confidence interval of `stamps`, from a jackknife [s]."""
    arrival: float
    """Mean time from a frame's time stamp until the frame is available [s]."""
    latest: float
    """99 % quantile of the time from a frame's time stamp until the frame is available [s]."""
    agreement: float
    """Fraction of the variance of the fin angle that the pictures explain, 0 to 1."""
    frames: int
    """Number of frames in the estimate."""

    @property
    def total(self) -> float:
        """Mean time from the middle of the exposure until the frame is available [s]."""
        return self.stamps + self.arrival


def find_latency(frames: Sequence[Frame], forces: Sequence[Force]) -> Latency:
    """Return the latency, estimated from a swim with many frequencies.

    frames, forces: in order of time

    Raises `NoMotion`, and `NoDelay` where there are too few frames or forces, or they disagree.
    """
    if not forces or forces[-1].end - forces[0].begin < MIN_SWIM_S:
        raise NoDelay(f"{MIN_SWIM_S:g} s of swimming are needed to measure a delay")
    angle = ForceAngle(forces)
    inside = [
        frame
        for frame in frames
        if angle.first + MAX_DELAY_S < frame.time < angle.last + MIN_DELAY_S
    ]
    if len(inside) < 100:
        raise NoDelay(f"{len(inside)} frames are too few to measure a delay; 100 are needed")
    times = np.array([frame.time for frame in inside])
    position = find_tail_positions(np.stack([frame.pixels for frame in inside]))
    position /= position.std()
    fit = Fit(angle, times, position)
    delay, log_rate = fit.best()
    agreement = 1.0 - fit.misfit(delay, log_rate)
    if agreement < _MIN_AGREEMENT:
        raise NoDelay(
            f"pictures and forces agree by {max(0.0, agreement):.0%} only: is it the same fish, "
            "and does the camera see its whole tail?"
        )
    left_out = [
        Fit(angle, times[kept], position[kept]).near(delay, log_rate)[0]
        for kept in leave_out_parts(len(times))
    ]
    ci95 = STUDENT * math.sqrt((JACKKNIFE_PARTS - 1) * float(np.var(left_out)))
    late = [frame.available - frame.time for frame in inside]
    return Latency(
        stamps=delay,
        ci95=ci95,
        arrival=float(np.mean(late)),
        latest=float(np.quantile(late, 0.99)),
        agreement=agreement,
        frames=len(inside),
    )


def leave_out_parts(number: int) -> list[NDArray[np.bool_]]:
    """Return for each part of a jackknife which of a number of values are kept."""
    part = np.arange(number) * JACKKNIFE_PARTS // number
    return [part != left_out for left_out in range(JACKKNIFE_PARTS)]


class ForceAngle:
    """Fin angle that follows from the forces, up to a scale and a drift."""

    def __init__(self, forces: Sequence[Force]) -> None:
        ends = np.array([force.end for force in forces])
        fy = np.array([force.fy for force in forces])
        fy -= fy.mean()
        edges = np.concatenate(([forces[0].begin], ends))
        impulse = np.concatenate(([0.0], np.cumsum(fy * np.diff(edges))))
        self.first, self.last = float(edges[0]), float(edges[-1])
        self._fine = np.arange(self.first, self.last, _STEP_S)
        self._impulse = -_interpolate_spline(self._fine, edges, impulse)
        # A power of two is fastest; twice the length keeps the circular convolution from wrapping.
        self._size = 2 ** (2 * len(self._fine) - 1).bit_length()
        self._spectrum = np.fft.rfft(self._impulse, self._size)
        self._angles_by_rate: dict[float, Floats] = {}

    def at(self, times: Floats, rate: float) -> Floats:
        """Return α · K for K_d/K = `rate` [1/s], the solution of α̇ + rate · α = −(∫ F_y dt)/K."""
        angles = self._angles_by_rate.get(rate)
        if angles is None:
            kernel = np.exp(-rate * _STEP_S * np.arange(len(self._fine)))
            spectrum = self._spectrum * np.fft.rfft(kernel, self._size)
            angles = np.fft.irfft(spectrum, self._size)[: len(self._fine)] * _STEP_S
            # The trapezoidal rule counts half of the last point.
            angles -= 0.5 * _STEP_S * self._impulse
            self._angles_by_rate = {rate: angles}
        return np.asarray(np.interp(times, self._fine, angles))


class Fit:
    """Fit of pictures to forces, over the delay and the rate K_d/K."""

    def __init__(self, angle: ForceAngle, times: Floats, position: Floats) -> None:
        self._angle, self._times = angle, times
        span = times[-1] - times[0]
        along = (times - times[0]) / span
        slow = [np.cos(math.pi * k * along) for k in range(int(2 * _MIN_FREQUENCY_HZ * span) + 1)]
        self._drift = np.linalg.qr(np.stack([*slow, along, along**2, along**3], axis=1))[0]
        seen = np.stack([position, position**3], axis=1)
        self._seen = np.linalg.qr(_residual_after(self._drift, seen))[0]

    def misfit(self, *point: float) -> float:
        """Return the fraction of the angle's variance that the pictures do not explain."""
        residual = self.residual(*point)
        return float(residual @ residual)

    def best(self) -> tuple[float, ...]:
        """Return the delay [s] and the logarithm of the rate of the best fit."""
        grid = [
            (float(delay), float(log_rate))
            for log_rate in np.linspace(math.log(_RATE_RANGE[0]), math.log(_RATE_RANGE[1]), 10)
            for delay in np.arange(MIN_DELAY_S, MAX_DELAY_S, 0.02)
        ]
        return self.near(*min(grid, key=lambda point: self.misfit(*point)))

    def near(self, *begin: float) -> tuple[float, ...]:
        """Return the arguments of `residual` that fit best close to these, two or three.

        The method is that of Levenberg and Marquardt.
        """
        point, damping = np.array(begin), 1e-3
        probes = _PROBES[: len(point), : len(point)]
        residual = self.residual(*point)
        for _ in range(40):
            slopes = np.stack(
                [(self.residual(*(point + step)) - residual) / step.sum() for step in probes],
                axis=1,
            )
            normal = slopes.T @ slopes
            damped = normal + damping * np.diag(np.diag(normal))
            move = np.linalg.lstsq(damped, -slopes.T @ residual, rcond=None)[0]
            new_residual = self.residual(*(point + move))
            if not new_residual @ new_residual < residual @ residual:
                damping *= 10.0
                if damping > 1e6:
                    break
                continue
            point, residual, damping = point + move, new_residual, 0.1 * damping
            if abs(move[0]) < 1e-6:
                break
        return tuple(point.tolist())

    def residual(self, delay: float, log_rate: float, stretch: float = 0.0) -> Floats:
        """Return what the pictures do not explain of the angle, which has the norm 1.

        stretch: relative error of the pictures' clock, about the middle of their times
        """
        times = self._times - delay + stretch * (self._times - 0.5 * self._times[[0, -1]].sum())
        angle = _residual_after(self._drift, self._angle.at(times, math.exp(log_rate)))
        angle /= np.linalg.norm(angle)
        return _residual_after(self._seen, angle)


_PROBES = np.diag([1e-4, 1e-3, 1e-5])
"""Steps of the arguments of `Fit.residual` for numerical derivatives."""


def _residual_after(basis: Floats, values: Floats) -> Floats:
    """Return the residual of values after projection on an orthonormal basis."""
    return np.asarray(values - basis @ (basis.T @ values))


def _interpolate_spline(at: Floats, x: Floats, y: Floats) -> Floats:
    """Return the Catmull-Rom spline through points with about equal distances."""
    slopes = np.gradient(y, x)
    index = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    h = x[index + 1] - x[index]
    s = (at - x[index]) / h
    left, right = slopes[index] * h, slopes[index + 1] * h
    rise = y[index + 1] - y[index]
    square, cube = 3.0 * rise - 2.0 * left - right, left + right - 2.0 * rise
    return np.asarray(y[index] + s * (left + s * (square + s * cube)))


def find_tail_positions(pictures: NDArray[np.uint8]) -> Floats:
    """Return the tail's deflection towards the higher rows [px], in ten or more pictures.

    pictures: shape (number, height, width)

    The tail consists of the pixels that differ from the median picture, towards dark or light,
    whichever differs more. Its position is the mean distance of its pixels from the axis of motion.
    Raises `NoMotion`.
    """
    motion = find_motion(pictures)
    height, width = motion.energy.shape
    moving = motion.energy > _MOTION_THRESHOLD * motion.energy.max()
    rows, columns = np.nonzero(moving)
    values = pictures[:, rows, columns].astype(np.float32)
    light = pictures.mean(axis=(1, 2), dtype=np.float32)
    values *= (float(light.mean()) / np.maximum(light, 1.0))[:, None]
    values -= np.median(values, axis=0)
    if float(np.einsum("ij,ij,ij->", values, values, values, dtype=np.float64)) < 0.0:
        values = -values
    values -= _TAIL_THRESHOLD * float(np.quantile(values, 0.99))
    np.maximum(values, 0.0, out=values)
    distance = (rows - motion.axis.rows(height, width)[columns]).astype(np.float32)
    mass = values.sum(axis=1)
    positions: Floats = (values @ distance / np.maximum(mass, 1e-6)).astype(np.float64)
    return positions
