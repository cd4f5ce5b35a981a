"""Many tethered fish at once, as arrays, for trainings that need thousands of different ones.

The equations are those of `TetheredFish`. A tick has `STEPS` steps, and an instruction reaches the
servo at the start of one: so the delay of a servo counts in whole steps, and the thrust of a tick
has an error of about a per cent. In return a tick of a fish takes less than a microsecond.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fishd.virtual.plant.parameters import TETHERED, PlantParameters
from fishd.virtual.plant.tethered import REACTION_TIME

Array = NDArray[np.float64]

STEPS = 10
"""Number of steps of a tick."""
_FALLING_TICKS = 3
"""Distance from the best half beats of all fish from which longer ones are not computed [ticks]."""
_TAYLOR_TERMS = 14
"""Number of terms of the exponential of a step."""
_NAMES = (
    *("omega0", "xi", "coupling", "servo_speed", "servo_lag", "thrust_coefficient"),
    *("lateral_drag", "lateral_inertia_ratio", "servo_delay", "backlash", "servo_dead_zone"),
    *("servo_reaction", "cable_slack"),
)
"""Parameters of a fish that its motion depends on."""


def is_possible(plant: PlantParameters) -> bool:
    """Return whether the equations of this fish are those of a batch."""
    drag = plant.quadratic_drag or plant.lateral_quadratic_drag
    return plant.model == TETHERED and plant.servo_law == "tanh" and not drag


class FishBatch:
    """A batch of tethered fish, at rest at first; all arrays have shape (fish,)."""

    def __init__(self, plants: Sequence[PlantParameters], tick: float) -> None:
        """`tick` is the period of the loop [s]; `is_possible` must be true for all fish."""
        rows = np.array([[getattr(plant, name) for name in _NAMES] for plant in plants])
        self._omega0, self._xi, self._coupling, self._speed, self._lag = rows.T[:5]
        self._inertia, self._drag, ratio, delay, self._play = rows.T[5:10]
        self._dead_zone, self._reaction, self._slack = rows.T[10:]
        self._side_inertia = ratio * self._inertia
        self._tick, self._step = tick, tick / STEPS
        self._numbers = np.arange(len(plants))
        self._motion = _step_motion(self._omega0, self._xi, self._step)
        self._lag_decay = np.exp(-self._step * self._speed / self._lag)
        middles = (np.arange(STEPS) + 0.5)[:, None] * self._step
        self._late = np.ceil((delay - middles) / tick).clip(0).astype(int)
        """Age of the instruction at the servo in each step [ticks], shape (STEPS, fish)."""
        self.rest()

    def rest(self) -> None:
        """Return all fish to rest at neutral."""
        zeros = np.zeros(len(self._numbers))
        self._instructions = np.zeros((int(self._late.max()) + 1, len(self._numbers)))
        self._wheel = self._tail = self._alpha = self._rate = self._momentum = zeros

    def advance(self, angles: Array) -> tuple[Array, Array]:
        """Hold instruction angles for a tick [rad]; return the means of F_x and F_y [N]."""
        self._instructions[1:] = self._instructions[:-1]
        self._instructions[0] = angles
        alpha, rate, momentum = self._alpha, self._rate, self._momentum
        kept = np.exp(-self._step / REACTION_TIME)
        pull = self._pull()
        product = self._product(pull)
        total = np.zeros_like(alpha)
        for late in self._late:
            wheel = self._wheel
            self._turn(self._instructions[late, self._numbers])
            impulse = self._reaction * (self._wheel - wheel) / self._step
            self._momentum = kept * self._momentum - (1.0 - kept) * impulse
            before, pull = pull, self._pull()
            cause = np.stack((self._alpha, self._rate, before, pull - before))
            self._alpha, self._rate = np.einsum("ijk,jk->ik", self._motion, cause)
            previous, product = product, self._product(pull)
            total += 0.5 * (previous + product)
        change = self._side_inertia * (self._rate - rate) + self._drag * (self._alpha - alpha)
        change -= self._momentum - momentum
        return -self._inertia * total / STEPS, -change / self._tick

    def half_beat_thrusts(self, amplitude: float, longest: int) -> Array:
        """Return the mean thrust of square waves with half beats of 0 to `longest` ticks [N].

        Shape (fish, longest + 1); it is 0 for less than two ticks. Once half beats are too long for
        all fish, longer ones count as equal. The fish are at rest afterwards.

        amplitude: Φ [rad]
        """
        late, self._late = self._late, np.zeros_like(self._late)  # it only shifts the motion
        thrusts = np.zeros((len(self._numbers), longest + 1))
        angles = np.full(len(self._numbers), amplitude)
        swing = np.maximum(amplitude - self._dead_zone, 0.0)
        step = 2.0 * swing / self._lag
        for ticks in range(2, longest + 1):
            # The lag of a periodic wheel after a reversal: see `lag_after_reversal`.
            time = ticks * self._tick * self._speed / self._lag
            lag = 0.5 * self._lag * (np.logaddexp(step, -time) - np.logaddexp(-step, -time))
            # Half a beat is an affine map of the fin's state, and negates the periodic one.
            self._begin_half_beat(swing - lag, np.zeros((len(lag), 2)))
            self._mean_thrust(angles, ticks)
            forced = np.stack((self._alpha, self._rate), axis=-1)[..., None]
            free = np.linalg.matrix_power(np.moveaxis(self._motion[:, :2], -1, 0), ticks * STEPS)
            periodic = np.linalg.solve(free + np.eye(2), -forced)[..., 0]
            self._begin_half_beat(swing - lag, periodic)
            thrusts[:, ticks] = self._mean_thrust(angles, ticks)
            if ticks >= thrusts.argmax(axis=1).max() + _FALLING_TICKS:
                thrusts[:, ticks:] = thrusts[:, ticks : ticks + 1]
                break
        self._late = late
        self.rest()
        return thrusts

    def _begin_half_beat(self, wheel: Array, fin: NDArray[Any]) -> None:
        """Set the state after a reversal [rad]; fin: α and α̇, shape (fish, 2)."""
        self._wheel, self._tail = wheel, np.minimum(wheel + self._play, 0.0)
        self._alpha, self._rate = fin.T

    def _mean_thrust(self, angles: Array, ticks: int) -> Array:
        """Hold instruction angles for some ticks [rad]; return the mean F_x [N]."""
        thrust: Array = np.mean([self.advance(angles)[0] for _ in range(ticks)], axis=0)
        return thrust

    def _turn(self, instructions: Array) -> None:
        """Turn wheel and tail for a step towards the instruction angles at the servo [rad]."""
        error = instructions - self._wheel
        error = np.sign(error) * np.maximum(np.abs(error) - self._dead_zone, 0.0)
        later = self._lag * np.arcsinh(np.sinh(error / self._lag) * self._lag_decay)
        self._wheel = self._wheel + error - later
        self._tail = np.clip(self._tail, self._wheel - self._play, self._wheel + self._play)

    def _pull(self) -> Array:
        """Return the angle at which each fin would rest [rad]."""
        beyond = np.maximum(np.abs(self._tail) - self._slack, 0.0)
        pull: Array = self._coupling * np.copysign(beyond, self._tail)
        return pull

    def _product(self, pull: Array) -> Array:
        """Return α α̈ [rad²/s²]; pull: as returned by `_pull`."""
        acceleration = self._omega0**2 * (pull - self._alpha) - self._xi * self._omega0 * self._rate
        product: Array = self._alpha * acceleration
        return product


def _step_motion(omega0: Array, xi: Array, step: float) -> Array:
    """Return the matrices from α, α̇, the pull before a step and its change to α and α̇ after it.

    Shape (2, 4, fish). The pull changes linearly in a step [s].
    """
    rates = np.zeros((len(omega0), 4, 4))
    rates[:, 0, 1] = 1.0
    rates[:, 1, 0], rates[:, 1, 1], rates[:, 1, 2] = -(omega0**2), -xi * omega0, omega0**2
    rates[:, 2, 3] = 1.0 / step
    term = motion = np.broadcast_to(np.eye(4), rates.shape)
    for number in range(1, _TAYLOR_TERMS):
        term = term @ rates * (step / number)
        motion = motion + term
    return np.moveaxis(motion[:, :2], 0, -1)
