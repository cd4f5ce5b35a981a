"""An inextensible beam that bends as far as it likes, and bends itself: the body of the fish.

Geometrically exact: the shape is the angle θ of the midline, piecewise linear along the arc, and
the place of the head (Antman, Nonlinear Problems of Elasticity, chapter IV, without stretch and
shear). Bending energy ½∫EI (θ′ − κ)² dX, with the curvature κ that the muscles ask for; with θ as
unknown it is quadratic, so that the stiffness never changes.
"""

from collections.abc import Callable

import numpy as np

from fishd.virtual.swimmer.grid import Array

Profile = Callable[[Array], Array]
"""A quantity along the body, of the distance X from the head [m]."""


class Beam:
    """Unknowns q = (x, y of the head, θ at `segments` + 1 points); slices that move as rigid ones.

    Slices are short pieces of the body between two cross-sections: `slices` of them, of length
    `spacing`. Forces, moments and masses are those of a body one metre deep.
    """

    def __init__(
        self,
        length: float,
        half_thickness: Profile,
        stiffness: Profile,
        segments: int,
        spacing: float,
        *,
        density: float = 0.0,
        viscous_time: float = 0.0,
        clamped: bool = False,
    ) -> None:
        """length: of the midline [m]

        half_thickness: at X [m]; stiffness: EI at X [N m²]
        spacing: of the slices, at most [m]
        density: by which the body is heavier than water [kg/m³]
        viscous_time: viscosity over Young's modulus, of a Kelvin–Voigt body [s]
        clamped: does the head neither move nor turn?
        """
        per_segment = int(np.ceil(length / segments / spacing - 1e-9))
        self.length, self.segments, self.slices = length, segments, per_segment * segments
        self.spacing = length / self.slices
        self.X: Array = np.asarray((np.arange(self.slices) + 0.5) * self.spacing, np.float64)
        """Middle of each slice, from the head [m]."""
        self.half_thickness = half_thickness(self.X)
        self.taper = np.gradient(self.half_thickness, self.X)
        """How the half thickness grows with X."""
        self.clamped = clamped
        self.size = segments + 3
        """How many unknowns there are."""
        self.free = np.arange(3 if clamped else 0, self.size)
        """Which of the unknowns may change."""
        cell = length / segments
        self._weights = np.clip(
            1.0 - np.abs(self.X[:, None] / cell - np.arange(segments + 1)[None]), 0.0, None
        )
        self._EI = stiffness(self.X).reshape(segments, per_segment)
        bend = self._EI.mean(axis=1) / cell
        self.K = np.zeros((self.size, self.size))
        """Stiffness [N m]."""
        for k in range(segments):
            pair = np.ix_([k + 2, k + 3], [k + 2, k + 3])
            self.K[pair] += bend[k] * np.array([[1.0, -1.0], [-1.0, 1.0]])
        self.D = viscous_time * self.K
        """Damping of the material [N m s]."""
        area = 2.0 * self.half_thickness * self.spacing
        self.area = float(area.sum())
        """Of the body [m²]."""
        self.share = area / self.area
        """Share of the body that each slice is."""
        inertia = area * ((2.0 * self.half_thickness) ** 2 + self.spacing**2) / 12.0
        self.excess = density * np.stack([area, area, inertia], axis=1)
        """Mass and moment of inertia of each slice beyond those of the water; shape (slices, 3)."""
        self.q = np.zeros(self.size)
        self.rate = np.zeros(self.size)

    def drive(self, curvature: Profile) -> Array:
        """Forces on the unknowns by muscles that ask for this curvature [1/m]; shape (size,)."""
        asked = curvature(self.X).reshape(self.segments, -1)
        moment = (self._EI * asked).mean(axis=1)
        forces = np.zeros(self.size)
        forces[3:] += moment
        forces[2:-1] -= moment
        return forces

    def couple(self) -> Array:
        """Forces on the unknowns by a torque of 1 N m, spread over the body: no net force."""
        return np.concatenate([np.zeros(2), self.share @ self._weights])

    def shape(self, q: Array) -> tuple[Array, Array]:
        """Places of the slices, shape (slices, 2) [m], and their angles, shape (slices,) [rad]."""
        angle = self._weights @ q[2:]
        steps = np.empty((self.slices, 2))
        np.cos(angle, out=steps[:, 0])
        np.sin(angle, out=steps[:, 1])
        steps *= self.spacing
        places = steps.cumsum(axis=0)
        places += q[:2]
        places -= 0.5 * steps
        return places, angle

    def motion(self, angle: Array) -> Array:
        """How the slices move with the unknowns: shape (slices, 3, size), for vx, vy and θ̇."""
        moves = np.zeros((self.slices, 3, self.size))
        moves[:, 0, 0] = moves[:, 1, 1] = 1.0
        for row, lever in ((0, -np.sin(angle)), (1, np.cos(angle))):
            steps = self.spacing * lever[:, None] * self._weights
            moves[:, row, 2:] = np.cumsum(steps, axis=0) - 0.5 * steps
        moves[:, 2, 2:] = self._weights
        return moves

    def bending_energy(self, q: Array) -> float:
        """Stored in the shape, without any muscle [J]."""
        return float(0.5 * q @ self.K @ q)
