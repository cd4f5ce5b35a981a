"""Fast simulation of the response of a fish to recorded commands, for a fit.

The same equations as fishd.virtual.plant, for a whole run at once: the servo in closed form, tick
by tick; the fin, which is linear, by its exact discrete filter on a grid that is shifted by the
delay, so that every step of the command is at a grid point.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import lfilter

from fishd.virtual.plant.servo_law import Approach, ServoLaw
from fishd.virtual.plant.tethered import REACTION_TIME

Array = NDArray[np.float64]

_MAX_STEP_S = 0.0025
"""Largest step of the grid [s]."""
_MAX_SAMPLES = 40
"""Largest number of samples in a period; more would not change the mean force."""
_MAX_ITERATIONS = 100
"""Largest number of iterations for quadratic drag."""
_MAX_LAGS = 700.0
"""Largest distance of the servo from its command, in lags Δ, as sinh overflows beyond it."""
_TOLERANCE = 1e-7
"""Largest change of the fin's speed in the last iteration, relative to its largest speed."""
_SLOTS_BEFORE = 2
"""Number of slots before the first command, in which the servo already holds it."""


@dataclass(frozen=True)
class Drive:
    """Parameters of the servo and of the fin; docs/explanation/concepts.md explains the symbols."""

    omega0: float
    """Natural frequency ω₀ [rad/s]."""
    xi: float
    """Damping ξ [1]."""
    servo_speed: float
    """Speed of the servo Ω [rad/s]."""
    servo_lag: float
    """Lag of the servo Δ [rad]."""
    servo_delay: float = 0.0
    """Dead time of the servo [s]."""
    backlash: float = 0.0
    """Backlash [rad]."""
    cable_slack: float = 0.0
    """Slack of the cables [rad]."""
    servo_dead_zone: float = 0.0
    """Dead zone of the servo [rad]."""
    quadratic_drag: float = 0.0
    """Quadratic drag times coupling, cλ, as the fin here has λ = 1 [1/rad]."""
    servo_law: ServoLaw = "tanh"
    """Law by which the wheel approaches its instruction."""


@dataclass(frozen=True)
class Motion:
    """Motion of the wheel and of a fin with λ = 1, at the points of a grid."""

    servo: tuple[float | str, ...]
    """Parameters of the drive that determine the motion of the wheel."""
    pull: Array
    """Wheel angle that drives the fin, at the points and half way between them [rad]."""
    turned: Array
    """Angle of the wheel itself at the same instants [rad]."""
    rate: Array
    """Speed of the fin [rad/s]."""


def response(
    drive: Drive, commands: Array, ends: NDArray[np.int_], tick: float, samples: int
) -> Array:
    """Return the forces of `respond`."""
    return respond(drive, commands, ends, tick, samples)[0]


def respond(
    drive: Drive,
    commands: Array,
    ends: NDArray[np.int_],
    tick: float,
    samples: int,
    near: Motion | None = None,
) -> tuple[Array, Motion]:
    """Return the forces on the sensor, and the motion.

    The forces are window means of [−α α̈, −α̈, −α̇, −φ̈, −|α̇| α̇] for λ = 1, of shape
    (5, len(ends) − 1).

    With coupling λ, F_x = K λ² · row 0, and F_y = K_y λ · row 1 + K_d λ · row 2 + J · row 3 +
    K_q λ² · row 4. Row 3 is smoothed as by the mount of the servo.

    commands: φ_c in each slot of one period [rad], from the start on
    ends: slots at whose starts windows end; the first one begins where the first window does
    tick: one period [s]
    samples: number of samples in each mean, evenly spaced over each period
    near: motion for the same commands and a similar drive, to save time
    """
    samples = min(samples, _MAX_SAMPLES)
    stride = math.ceil(tick / (samples * _MAX_STEP_S))
    steps = stride * samples
    h = tick / steps
    slots_before = _SLOTS_BEFORE + math.ceil(drive.servo_delay / tick - 1e-9)
    held_commands = np.concatenate((np.full(slots_before, commands[0]), commands))
    servo = (
        *(drive.servo_speed, drive.servo_lag, drive.backlash, drive.cable_slack),
        *(drive.servo_dead_zone, float(slots_before), drive.servo_law),
    )
    if near and near.servo == servo:
        pull, turned = near.pull, near.turned
    else:
        pull, turned = _wheel_motion(drive, held_commands, steps, tick)
    similar = near.rate if near and near.pull.size == pull.size else None
    alpha, rate = _fin(drive, pull, h, similar)
    # Slot k of the commands begins at k·tick; its command applies from grid point
    # (k + slots_before)·steps on, which is servo_delay later. So its first sample is here:
    position = slots_before * steps - drive.servo_delay / h + 0.5 * stride
    first = math.floor(position)
    fraction = position - first
    slots = int(ends[-1])

    def sample_grid(values: Array, later: int = 0, factor: int = 1) -> Array:
        return values[factor * first + later :: factor * stride][: slots * samples]

    acceleration = _acceleration(drive, alpha, rate, pull[::2])
    rates, next_rates = sample_grid(rate), sample_grid(rate, 1)
    a = _hermite(sample_grid(alpha), sample_grid(alpha, 1), rates, next_rates, fraction, h)
    v = _hermite(
        rates, next_rates, sample_grid(acceleration), sample_grid(acceleration, 1), fraction, h
    )
    pulls = sample_grid(pull, 0, 2), sample_grid(pull, 1, 2), sample_grid(pull, 2, 2)
    pulled = np.tensordot(_parabola(fraction), np.stack(pulls), 1)
    minus = -_acceleration(drive, a, v, pulled)
    sums = np.stack((a * minus, minus, -v, -np.abs(v) * v))
    sums = sums.reshape(4, slots, samples).sum(axis=2)
    means: Array = np.add.reduceat(sums, ends[:-1], axis=1) / (samples * np.diff(ends))
    edges = 2.0 * (slots_before * steps - drive.servo_delay / h + ends * steps)
    mount_rates = np.interp(edges, np.arange(turned.size), _smoothed_speed(turned, 0.5 * h))
    reaction = -np.diff(mount_rates) / (tick * np.diff(ends))
    forces = np.vstack((means[:3], reaction, means[3]))
    return forces, Motion(servo, pull, turned, rate)


def _smoothed_speed(angles: Array, step: float) -> Array:
    """Return the speed of the wheel, smoothed by the mount of the servo [rad/s].

    angles: angles of the wheel [rad]; step: their spacing [s]
    """
    decay = math.exp(-step / REACTION_TIME)
    speeds = np.diff(angles, prepend=angles[0]) / step
    smoothed: Array = lfilter([1.0 - decay], [1.0, -decay], speeds)
    return smoothed


def _wheel_motion(drive: Drive, commands: Array, steps: int, tick: float) -> tuple[Array, Array]:
    """Return the wheel angle that drives the fin, and the angle of the wheel itself [rad].

    Both are at the grid points and half way between them.
    """
    if drive.servo_law != "tanh":
        turned = _approaches(drive, commands, 0.5 * tick / steps, 2 * steps)
        return _take_up_slack(drive, _follow_with_play(turned, drive.backlash)), turned
    speed, lag = drive.servo_speed, drive.servo_lag
    dead, play = drive.servo_dead_zone, drive.backlash
    decay = math.exp(-speed * tick / lag)
    sinh, asinh = math.sinh, math.asinh
    targets, sinhs, tails = [], [], []
    phi = tail = float(commands[0])
    for command in commands.tolist():
        if dead:
            gap = command - phi
            command = phi if abs(gap) <= dead else command - math.copysign(dead, gap)
        targets.append(command)
        size = sinh(max(-_MAX_LAGS, min(_MAX_LAGS, (command - phi) / lag)))
        sinhs.append(size)
        tails.append(tail)
        phi = command - lag * asinh(size * decay)
        if play:
            tail = max(phi - play, min(phi + play, tail))
    times = np.arange(2 * steps) * (0.5 * tick / steps)
    lag_angle = np.arcsinh(np.multiply.outer(np.array(sinhs), np.exp(times * (-speed / lag))))
    wheel = np.array(targets)[:, None] - lag * lag_angle
    turned = np.append(wheel.ravel(), phi)
    if play:  # within a slot the wheel turns one way only
        wheel = np.clip(np.array(tails)[:, None], wheel - play, wheel + play)
    pull = np.append(wheel.ravel(), tail if play else phi)
    return _take_up_slack(drive, pull), turned


def _approaches(drive: Drive, commands: Array, step: float, steps: int) -> Array:
    """Return the angle of a wheel with another law than tanh [rad].

    step: time between two angles [s]; steps: number of them in a slot
    """
    lag, dead = drive.servo_lag, drive.servo_dead_zone
    phi, speed = float(commands[0]), 0.0
    begins = [0, *(np.flatnonzero(np.diff(commands)) + 1).tolist(), len(commands)]
    angles = [np.array([phi])]
    for begin, end in pairwise(begins):
        gap = float(commands[begin]) - phi
        if dead:
            gap = math.copysign(max(0.0, abs(gap) - dead), gap)
        approach = Approach(drive.servo_law, gap / lag, speed)
        times = np.arange(1.0, (end - begin) * steps + 1.0) * (step * drive.servo_speed / lag)
        lags, speeds, _ = approach.at(times)
        angles.append(phi + gap - lag * lags)
        phi, speed = float(angles[-1][-1]), float(speeds[-1])
    return np.concatenate(angles)


def _follow_with_play(wheel: Array, play: float) -> Array:
    """Return the angle of a tail with backlash [rad]: between two turns, it is a bound."""
    if not play:
        return wheel
    steps = np.diff(wheel)
    moving = np.flatnonzero(steps)
    turns = moving[1:][steps[moving[1:]] * steps[moving[:-1]] < 0.0] + 1
    tail, pieces = float(wheel[0]), []
    for piece in np.split(wheel, turns):
        pieces.append(np.clip(tail, piece - play, piece + play))
        tail = float(pieces[-1][-1])
    return np.concatenate(pieces)


def _take_up_slack(drive: Drive, pull: Array) -> Array:
    """Return the angle of the tail behind slack cables [rad]."""
    if not drive.cable_slack:
        return pull
    slack: Array = np.sign(pull) * np.maximum(np.abs(pull) - drive.cable_slack, 0.0)
    return slack


def _acceleration(drive: Drive, angle: Array, rate: Array, pull: Array) -> Array:
    """Return α̈ of the fin for λ = 1."""
    acceleration = -drive.xi * drive.omega0 * rate - drive.omega0**2 * (angle - pull)
    if drive.quadratic_drag:
        acceleration -= drive.quadratic_drag * np.abs(rate) * rate
    return acceleration


def _fin(drive: Drive, pull: Array, h: float, similar: Array | None) -> tuple[Array, Array]:
    """Return α and α̇ at the grid points for λ = 1, from rest at the first pull.

    Quadratic drag is computed by iteration: the fin is a linear filter of the pull and of the drag
    in the last iteration. A linear drag of about its size, c·m, is part of the filter, so that
    only the remainder, c (|α̇| − m) α̇, is iterated.

    similar: initial guess of the speed [rad/s]
    """
    drag = drive.quadratic_drag
    if not drag:
        return _linear_fin(drive.omega0, drive.xi, pull, h)
    rate = _linear_fin(drive.omega0, drive.xi, pull, h)[1] if similar is None else similar
    mean = 2.0 * float(np.abs(rate).mean())
    xi = drive.xi + drag * mean / drive.omega0
    drag_ratio = drag / drive.omega0**2
    shrinks = min(1.0, 2.0 * drag * mean / (xi * drive.omega0))
    for _ in range(_MAX_ITERATIONS):
        rates = np.empty_like(pull)
        rates[::2] = rate
        # A cubic through four points; the ends are at rest and at the end of what is used.
        rates[1::2] = 0.5 * (rate[1:] + rate[:-1])
        bend = rate[3:] - rate[2:-1] - rate[1:-2] + rate[:-3]
        rates[3:-3:2] -= 0.0625 * bend
        driven = pull - drag_ratio * (np.abs(rates) - mean) * rates
        previous_rate = rate
        alpha, rate = _linear_fin(drive.omega0, xi, driven, h)
        if shrinks * np.abs(rate - previous_rate).max() <= _TOLERANCE * np.abs(rate).max():
            break
    return alpha, rate


def _linear_fin(omega0: float, xi: float, pull: Array, h: float) -> tuple[Array, Array]:
    """Return α and α̇ at the grid points of a fin without quadratic drag, from rest."""
    free, push = _discretise(omega0, xi, h)
    relative = pull - pull[0]
    cells = np.stack((relative[:-2:2], relative[1:-1:2], relative[2::2]))
    kick_a, kick_v = push @ cells
    (p, q), (r, s) = free.tolist()
    # x(n+1) = free x(n) + kick(n), solved for each component: both satisfy the characteristic
    # equation of `free`.
    denominator = [1.0, -(p + s), p * s - q * r]
    zero = np.zeros(1)
    a_before, v_before = np.concatenate((zero, kick_a[:-1])), np.concatenate((zero, kick_v[:-1]))
    alpha = lfilter([1.0], denominator, kick_a + q * v_before - s * a_before)
    rate = lfilter([1.0], denominator, kick_v + r * a_before - p * v_before)
    return np.concatenate((zero, alpha)) + pull[0], np.concatenate((zero, rate))


@lru_cache(maxsize=64)
def _discretise(omega0: float, xi: float, h: float) -> tuple[Array, Array]:
    """Return the free motion over h, (2, 2), and the effect of a parabolic pull, (2, 3).

    The pull is given at start, middle and end of the cell.
    """
    fin = np.array([[0.0, 1.0], [-(omega0**2), -xi * omega0]])
    chain = np.zeros((5, 5))
    chain[:2, :2] = fin
    chain[1, 2] = omega0**2
    chain[2, 3] = chain[3, 4] = 1.0
    moved = expm(chain * h)
    # The states 2, 3, 4 of the chain are the pull and its derivatives at the start of a cell.
    fit = np.array([[1.0, 0.0, 0.0], [-3 / h, 4 / h, -1 / h], [4 / h**2, -8 / h**2, 4 / h**2]])
    return moved[:2, :2], moved[:2, 2:] @ fit


def _hermite(
    values: Array, next_values: Array, slopes: Array, next_slopes: Array, fraction: float, h: float
) -> Array:
    """Return cubic interpolations in cells of length h, at `fraction` of each, 0 ≤ fraction < 1."""
    s, t = fraction, 1.0 - fraction
    return (
        (1.0 + 2.0 * s) * t * t * values
        + (1.0 + 2.0 * t) * s * s * next_values
        + h * s * t * (t * slopes - s * next_slopes)
    )


def _parabola(s: float) -> tuple[float, float, float]:
    """Return the weights at `s` of the values at start, middle and end of a cell."""
    return (1.0 - s) * (1.0 - 2.0 * s), 4.0 * s * (1.0 - s), s * (2.0 * s - 1.0)
