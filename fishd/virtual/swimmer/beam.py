"""Inextensible beam with large bends and muscles, the body of the fish.

It is geometrically exact: the shape is the angle θ of the midline, piecewise linear along the arc,
and the position of the head (Antman, Nonlinear Problems of Elasticity, chapter IV, without stretch
and shear). The bending energy is ½∫EI (θ′ − κ)² dX with the curvature κ that the muscles command.
With θ as the unknown it is quadratic, so that the stiffness is constant.
"""

from collections.abc import Callable

import numpy as np

from fishd.virtual.swimmer.grid import Array

Profile = Callable[[Array], Array]
"""Quantity along the body as a function of the distance X from the head [m]."""


class Beam:
    """Beam with the unknowns q = (x, y of the head, θ at `segments` + 1 points) and rigid slices.

    The body consists of `slices` short pieces between two cross-sections, of length `spacing`.
    Forces, moments and masses are those of a body one metre deep.
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
        """length: length of the midline [m]

        half_thickness: half thickness at X [m]; stiffness: EI at X [N m²]
        spacing: largest length of a slice [m]
        density: density of the body minus that of the water [kg/m³]
        viscous_time: viscosity over Young's modulus of a Kelvin–Voigt body [s]
        clamped: whether the head is fixed in place and angle
        """
        per_segment = int(np.ceil(length / segments / spacing - 1e-9))
        self.length, self.segments, self.slices = length, segments, per_segment * segments
        self.spacing = length / self.slices
        self.X: Array = np.asarray((np.arange(self.slices) + 0.5) * self.spacing, np.float64)
        """Distance of the middle of each slice from the head [m]."""
        self.half_thickness = half_thickness(self.X)
        self.taper = np.gradient(self.half_thickness, self.X)
        """Derivative of the half thickness with respect to X."""
        self.clamped = clamped
        self.size = segments + 3
        """Number of unknowns."""
        self.free = np.arange(3 if clamped else 0, self.size)
        """Indices of the unknowns that may change."""
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
        """Area of the body [m²]."""
        self.share = area / self.area
        """Fraction of the body's area in each slice."""
        inertia = area * ((2.0 * self.half_thickness) ** 2 + self.spacing**2) / 12.0
        self.excess = density * np.stack([area, area, inertia], axis=1)
        """Mass and moment of inertia of each slice minus those of the water, shape (slices, 3)."""
        self.q = np.zeros(self.size)
        self.rate = np.zeros(self.size)

    def drive(self, curvature: Profile) -> Array:
        """Return the forces on the unknowns of muscles with this curvature [1/m], shape (size,)."""
        commanded = curvature(self.X).reshape(self.segments, -1)
        moment = (self._EI * commanded).mean(axis=1)
        forces = np.zeros(self.size)
        forces[3:] += moment
        forces[2:-1] -= moment
        return forces

    def couple(self) -> Array:
        """Return the forces on the unknowns of a distributed torque of 1 N m, without net force."""
        return np.concatenate([np.zeros(2), self.share @ self._weights])

    def shape(self, q: Array) -> tuple[Array, Array]:
        """Return the positions (slices, 2) [m] and angles (slices,) [rad] of the slices."""
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
        """Return the Jacobian of vx, vy and θ̇ of the slices, shape (slices, 3, size)."""
        jacobian = np.zeros((self.slices, 3, self.size))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        for row, lever in ((0, -np.sin(angle)), (1, np.cos(angle))):
            steps = self.spacing * lever[:, None] * self._weights
            jacobian[:, row, 2:] = np.cumsum(steps, axis=0) - 0.5 * steps
        jacobian[:, 2, 2:] = self._weights
        return jacobian
