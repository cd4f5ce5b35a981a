"""Fast simulation of the response of a fish to recorded commands, for a fit.

The same equations as fishd.virtual.plant, for a whole run at once: the servo in closed form,
command by command; the fin, which is linear, by its exact discrete filter on a grid that is shifted
by the delay, so that every step of the command is at a grid point.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import lfilter

from fishd.virtual.plant.servo_law import Approach, ServoLaw
from fishd.virtual.plant.tethered import REACTION_TIME

Array = NDArray[np.float64]

MAX_STEP_S = 0.0025
"""Largest step of the grid [s]."""
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
    alpha: Array
    """Angle of the fin at the points [rad]."""
    rate: Array
    """Speed of the fin [rad/s]."""
    begin: float
    """Point at which the commands of the passage begin, in steps."""
    step: float
    """Distance of two points [s]."""

    def fin_angles(self, times: Array) -> Array:
        """Return the angle of the fin at times since the start of the passage [s], for λ = 1."""
        cell, fraction = _find_cells(self.begin + times / self.step, self.alpha.size)
        alpha, rate, later = self.alpha, self.rate, cell + 1
        return _hermite(alpha[cell], alpha[later], rate[cell], rate[later], fraction, self.step)


@dataclass(frozen=True)
class Timing:
    """Times of a passage [s], since the start of its first slot."""

    tick: float
    """Period of the loop."""
    begins: Array
    """Begin of each command, without the delay of the servo, shape (slots,)."""
    spans: Array
    """Begin of the first and end of the last sample of each window, shape (2, windows)."""
    sizes: NDArray[np.int_]
    """Number of samples in each window, which share its span evenly, shape (windows,)."""
    steps: int
    """Number of steps of the grid in a period; a command begins at the nearest grid point."""

    @cached_property
    def samples(self) -> Array:
        """Times of all samples [s]: the middles of equal parts of the spans."""
        numbers = np.arange(self.sizes.sum()) - np.repeat(self.first_samples, self.sizes)
        begins, ends = self.spans
        spacing = (ends - begins) / self.sizes
        times: Array = np.repeat(begins, self.sizes) + (numbers + 0.5) * np.repeat(
            spacing, self.sizes
        )
        return times

    @cached_property
    def first_samples(self) -> NDArray[np.int_]:
        """Index in `samples` of the first one of each window, shape (windows,)."""
        return np.concatenate(([0], np.cumsum(self.sizes)[:-1]))


def even_timing(ends: NDArray[np.int_], tick: float, samples: int) -> Timing:
    """Return the timing of commands at the starts of slots, with samples all over each window.

    ends: slots at whose starts windows end; the first one begins where the first window does
    tick: one period [s]
    samples: number of samples in each period
    """
    steps = math.ceil(tick / MAX_STEP_S - 1e-9)
    spans: Array = np.stack((ends[:-1], ends[1:])).astype(float) * tick
    begins: Array = np.arange(ends[-1]) * tick
    return Timing(tick, begins, spans, samples * np.diff(ends), steps)


def response(
    drive: Drive, commands: Array, ends: NDArray[np.int_], tick: float, samples: int
) -> Array:
    """Return the forces of `respond`, with the timing of `even_timing`."""
    return respond(drive, commands, even_timing(ends, tick, samples))[0]


def respond(
    drive: Drive, commands: Array, timing: Timing, near: Motion | None = None
) -> tuple[Array, Motion]:
    """Return the forces on the sensor, and the motion.

    The forces are window means of [−α α̈, −α̈, −α̇, −φ̈, −|α̇| α̇] for λ = 1, of shape (5, windows).

    With coupling λ, F_x = K λ² · row 0, and F_y = K_y λ · row 1 + K_d λ · row 2 + J · row 3 +
    K_q λ² · row 4. Row 3 is smoothed as by the mount of the servo.

    commands: φ_c in each slot of one period [rad], from the start on
    near: motion for the same commands and a similar drive, to save time
    """
    steps = timing.steps
    h = timing.tick / steps
    before = drive.servo_delay - min(0.0, float(timing.begins[0]))
    slots_before = _SLOTS_BEFORE + math.ceil(before / timing.tick - 1e-9)
    servo = (
        *(drive.servo_speed, drive.servo_lag, drive.backlash, drive.cable_slack),
        *(drive.servo_dead_zone, float(slots_before), drive.servo_law),
    )
    if near and near.servo == servo:
        pull, turned = near.pull, near.turned
    else:
        begins = slots_before * steps + np.rint(timing.begins / h).astype(int)
        end = max(int(begins[-1]), (slots_before + commands.size) * steps)
        lengths = np.diff(begins, prepend=0, append=end)
        held_commands = np.concatenate((commands[:1], commands))
        pull, turned = _wheel_motion(drive, held_commands, lengths, h)
    similar = near.rate if near and near.pull.size == pull.size else None
    alpha, rate = _fin(drive, pull, h, similar)
    acceleration = _acceleration(drive, alpha, rate, pull[::2])
    # A command acts at a grid point, which is servo_delay after its begin.
    start = slots_before * steps - drive.servo_delay / h
    cell, fraction = _find_cells(start + timing.samples / h, alpha.size)
    rates, next_rates = rate[cell], rate[cell + 1]
    a = _hermite(alpha[cell], alpha[cell + 1], rates, next_rates, fraction, h)
    v = _hermite(rates, next_rates, acceleration[cell], acceleration[cell + 1], fraction, h)
    pulls = np.stack([pull[2 * cell + later] for later in range(3)])
    pulled = np.einsum("kn,kn->n", np.stack(_parabola(fraction)), pulls)
    minus = -_acceleration(drive, a, v, pulled)
    sums = np.stack((a * minus, minus, -v, -np.abs(v) * v))
    means: Array = np.add.reduceat(sums, timing.first_samples, axis=1) / timing.sizes
    edges = 2.0 * (start + timing.spans / h)
    mount_rates = np.interp(edges, np.arange(turned.size), _smoothed_speed(turned, 0.5 * h))
    reaction = -np.diff(mount_rates, axis=0) / np.diff(timing.spans, axis=0)
    forces = np.vstack((means[:3], reaction, means[3]))
    return forces, Motion(servo, pull, turned, alpha, rate, start, h)


def _find_cells(position: Array, points: int) -> tuple[NDArray[np.int_], Array]:
    """Return the cell of each position on the grid, and the position in its cell, 0 to 1."""
    inside = np.clip(position, 0.0, points - 1.001)
    cell = inside.astype(int)
    return cell, inside - cell


def _smoothed_speed(angles: Array, step: float) -> Array:
    """Return the speed of the wheel, smoothed by the mount of the servo [rad/s].

    angles: angles of the wheel [rad]; step: their spacing [s]
    """
    decay = math.exp(-step / REACTION_TIME)
    speeds = np.diff(angles, prepend=angles[0]) / step
    smoothed: Array = lfilter([1.0 - decay], [1.0, -decay], speeds)
    return smoothed


def _wheel_motion(
    drive: Drive, commands: Array, lengths: NDArray[np.int_], h: float
) -> tuple[Array, Array]:
    """Return the wheel angle that drives the fin, and the angle of the wheel itself [rad].

    Both are at the grid points and half way between them.

    lengths: number of steps for which each command applies; h: one step [s]
    """
    if drive.servo_law != "tanh":
        turned = _approaches(drive, commands, 2 * lengths, 0.5 * h)
        return _take_up_slack(drive, _follow_with_play(turned, drive.backlash)), turned
    speed, lag = drive.servo_speed, drive.servo_lag
    dead, play = drive.servo_dead_zone, drive.backlash
    decays = np.exp(lengths * (-speed * h / lag)).tolist()
    sinh, asinh = math.sinh, math.asinh
    targets, sinhs, tails = [], [], []
    phi = tail = float(commands[0])
    for command, decay in zip(commands.tolist(), decays, strict=True):
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
    points = 2 * lengths
    elapsed = np.arange(points.sum()) - np.repeat(np.cumsum(points) - points, points)
    falls = np.exp(np.arange(points.max()) * (-0.5 * h * speed / lag))[elapsed]
    wheel = np.repeat(np.array(targets), points) - lag * np.arcsinh(
        np.repeat(np.array(sinhs), points) * falls
    )
    turned = np.append(wheel, phi)
    if play:  # for one command the wheel turns one way only
        wheel = np.clip(np.repeat(np.array(tails), points), wheel - play, wheel + play)
    pull = np.append(wheel, tail if play else phi)
    return _take_up_slack(drive, pull), turned


def _approaches(drive: Drive, commands: Array, lengths: NDArray[np.int_], step: float) -> Array:
    """Return the angle of a wheel with another law than tanh [rad].

    lengths: number of angles for which each command applies; step: time between two angles [s]
    """
    lag, dead = drive.servo_lag, drive.servo_dead_zone
    commands, lengths = commands[lengths > 0], lengths[lengths > 0]
    phi, speed = float(commands[0]), 0.0
    begins = [0, *(np.flatnonzero(np.diff(commands)) + 1).tolist(), len(commands)]
    angles = [np.array([phi])]
    for begin, end in pairwise(begins):
        gap = float(commands[begin]) - phi
        if dead:
            gap = math.copysign(max(0.0, abs(gap) - dead), gap)
        approach = Approach(drive.servo_law, gap / lag, speed)
        count = int(lengths[begin:end].sum())
        times = np.arange(1.0, count + 1.0) * (step * drive.servo_speed / lag)
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
    values: Array, next_values: Array, slopes: Array, next_slopes: Array, fraction: Array, h: float
) -> Array:
    """Return cubic interpolations in cells of length h, at `fraction` of each, 0 ≤ fraction < 1."""
    s, t = fraction, 1.0 - fraction
    return (
        (1.0 + 2.0 * s) * t * t * values
        + (1.0 + 2.0 * t) * s * s * next_values
        + h * s * t * (t * slopes - s * next_slopes)
    )


def _parabola(s: Array) -> tuple[Array, Array, Array]:
    """Return the weights at `s` of the values at start, middle and end of a cell."""
    return (1.0 - s) * (1.0 - 2.0 * s), 4.0 * s * (1.0 - s), s * (2.0 * s - 1.0)
