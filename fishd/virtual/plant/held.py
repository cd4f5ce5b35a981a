"""Several windows of a fish under a constant instruction, computed at once.

The wheel has a closed form under a constant instruction, and the fin is linear. One product of
matrices therefore gives several windows of one segment each, in about the time of a single one.
"""

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from fishd.virtual.plant.base import PlantState
from fishd.virtual.plant.collocation import N, Segment
from fishd.virtual.plant.motor import Motor, Stretch
from fishd.virtual.plant.parameters import PlantParameters

WINDOW_COUNT = 8
"""Number of windows that are computed at once."""


class HeldWindowMatrices:
    """Matrices for `WINDOW_COUNT` windows of one segment each, for one set of parameters."""

    def __init__(self, p: PlantParameters, segment: Segment, samples: int) -> None:
        """samples: number of samples in a window"""
        self.segment = segment
        steps = np.arange(WINDOW_COUNT)[:, None] * (segment.length * p.servo_speed / p.servo_lag)
        self.decays = np.exp(-(steps + segment.node_times))
        """Ratios, shape (WINDOW_COUNT, N), of sinh of the lags at nodes to that at the start."""
        motion, ends = segment.response[: 3 * N], segment.response[3 * N :]
        inertia, drag = p.thrust_coefficient, p.lateral_drag
        impulse = p.lateral_inertia * ends[1] + drag * ends[0]
        impulse[:2] -= (drag, p.lateral_inertia)
        sampled_impulse = p.lateral_inertia * ends[2] + drag * ends[3]
        side_forces = (-impulse / segment.length, -sampled_impulse / samples)
        self.response = np.vstack((motion, ends[:2], side_forces)).T
        """Matrix (N + 3, 3N + 4) from the cause of a window, as in `Segment.response`, to
        [α, α̇, α̈ at the nodes; α, α̇ at the end; mean F_y, sampled mean F_y]."""
        self.thrusts = -inertia * (segment.sums / ((segment.length,), (samples,))).T
        """Matrix (N, 2) from α α̈ at the nodes to [mean F_x, sampled mean F_x]."""
        starts = np.zeros((WINDOW_COUNT, 2, WINDOW_COUNT, N + 3))
        starts[0, :, 0, :2] = np.eye(2)
        for k in range(1, WINDOW_COUNT):
            starts[k] = np.tensordot(segment.free_motion, starts[k - 1], 1)
            starts[k, :, k - 1, 2:] += ends[:2, 2:]
        self.starts = starts.reshape(2 * WINDOW_COUNT, -1)
        """Matrix (2 WINDOW_COUNT, WINDOW_COUNT (N + 3)) from the causes of the windows, of which
        only the first has α₀ and α̇₀, to α₀ and α̇₀ of each window."""

    def swim(self, state: PlantState, target: float, lag: float) -> "HeldWindows":
        """Return the windows that follow `state`.

        target: λφ_c [rad]
        lag: lag/Δ at the start
        """
        causes = np.zeros((WINDOW_COUNT, N + 3))
        causes[0, :2] = state.alpha, state.alpha_rate
        causes[:, 2] = target
        lags = causes[:, 3:]
        np.multiply(self.decays, math.sinh(lag), out=lags)
        np.arcsinh(lags, out=lags)
        causes[:, :2] = self.starts.dot(causes.ravel()).reshape(WINDOW_COUNT, 2)
        motions = causes.dot(self.response)
        thrusts = (motions[:, :N] * motions[:, 2 * N : 3 * N]).dot(self.thrusts)
        stretch = Stretch(self.segment, motions, lags, True)
        return HeldWindows(stretch, motions[:, 3 * N :].tolist(), thrusts.tolist())


class HeldWindows:
    """Windows under a constant instruction, which are used one after the other."""

    def __init__(
        self, stretch: Stretch, ends: list[list[float]], thrusts: list[list[float]]
    ) -> None:
        """
        stretch: motion in all windows
        ends: α, α̇ at the end, mean F_y and sampled mean F_y of each window
        thrusts: mean F_x and sampled mean F_x of each window [N]
        """
        self.stretch, self.ends, self.thrusts = stretch, ends, thrusts
        self.taken = 0
        """Number of used windows."""
        self.jump = 0.0
        """Energy of the jump of the wheel's speed at the start [J]."""
        self.energies: list[float] = []
        """Energy of the motor in each window [J]; empty until `add_energies` is called."""

    def add_energies(self, motor: Motor) -> None:
        """Compute the energies."""
        self.energies = motor.energy(self.stretch).tolist()
        self.energies[0] += self.jump


class HeldWindow(Struct, frozen=True, eq=False):
    """One `Window` of `HeldWindows`."""

    duration: float
    thrust: float
    lateral_force: float
    sampled_thrust: float
    sampled_lateral_force: float
    held: HeldWindows
    number: int
    """Index of the window in `held`."""
    motor: Motor | None

    @property
    def course(self) -> Sequence[Stretch]:
        """Motion of wheel and fin in its single segment."""
        stretch, k = self.held.stretch, self.number
        return (Stretch(stretch.segment, stretch.response[k], stretch.lags[k], True),)

    @property
    def fin_peak(self) -> float:
        """Largest |α| within the window [rad]."""
        stretch = self.held.stretch
        return stretch.segment.peak(stretch.response[self.number])

    @property
    def power(self) -> float:
        """Mean electrical power of the servo [W]; NaN where the fish has no motor."""
        motor, held = self.motor, self.held
        if motor is None:
            return math.nan
        if not held.energies:
            held.add_energies(motor)
        return motor.idle + held.energies[self.number] / self.duration
