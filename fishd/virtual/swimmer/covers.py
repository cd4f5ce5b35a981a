"""Faces of the grid that a body covers, and the effect of the body on the water there.

A face near the surface of a body is a mixture of body and water. The velocity of the mixture is the
average of both with a kernel around the face (Maertens and Weymouth, Comput. Methods Appl. Mech.
Eng. 283, 2015, doi:10.1016/j.cma.2014.09.007; here χ = 1 − μ₀):

    χ · body + (1 − χ) · water + μ₁ · ∇(water − body)

The kernel is a cosine with a half width of one cell, ½(1 + cos πr), in both directions. μ₁ is the
first moment of the water in it. Without it, the method has first order: the water next to a body
moves with it, and the boundary layer is too thick by about half a cell.

Where a body is thinner than a cell, as near the tip of a tail, χ is below 1 even in its middle, and
it would let water through. Across itself, such a body therefore counts as one cell thick, and along
itself, where that would thicken its boundary layers, it keeps its own thickness.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fishd.virtual.swimmer.grid import MAX_SIZE_RATIO, Array, Field

MIN_HALF_THICKNESS = 0.5
"""Smallest half thickness of a body for the velocity across it [cells]."""


class Covered(NamedTuple):
    """Faces of one velocity component that a body covers at least in part; arrays of one length."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    owner: NDArray[np.int64]
    """Index of the nearest slice of the body."""
    chi: Array
    """χ, the fraction of the kernel around the face that is body."""
    mu1_x: Array
    """First moment μ₁ along x of the water in the kernel [cells]."""
    mu1_y: Array
    """First moment μ₁ along y of the water in the kernel [cells]."""


@njit(inline="always")
def kernel_integral(r: float) -> float:  # pragma: no cover
    """Return the part of the kernel that lies below r [cells]."""
    if r >= 1.0:
        return 1.0
    if r <= -1.0:
        return 0.0
    return 0.5 * (1.0 + r + math.sin(math.pi * r) / math.pi)


@njit(inline="always")
def kernel_moment(r: float) -> float:  # pragma: no cover
    """Return the first moment of the part of the kernel that lies above r [cells]."""
    if abs(r) >= 1.0:
        return 0.0
    angle = math.pi * r
    return 0.25 * (1.0 - r * r) - 0.5 * (
        r * math.sin(angle) / math.pi + (1.0 + math.cos(angle)) / math.pi**2
    )


def circle(px: Array, py: Array, radius: float, h: float) -> Covered:
    """Return the coverage by a circle.

    px, py: positions of the faces relative to its centre, shapes (nx,) and (ny,) [m]
    h: size of a cell [m]
    """
    i, j = np.nonzero(np.hypot(px[:, None], py[None]) < radius + h)
    x, y = px[i], py[j]
    distance = np.hypot(x, y)
    reach = (distance - radius) / h
    chi = np.array([1.0 - kernel_integral(r) for r in reach])
    mu1 = np.array([kernel_moment(r) for r in reach]) / np.maximum(distance, 0.5 * h)
    return Covered(i, j, np.zeros_like(i), chi, mu1 * x, mu1 * y)


class Painter:
    """Coverage of the faces of one velocity component by a moving body."""

    def __init__(self, k: int, px: Array, py: Array, h: float) -> None:
        """k: 0 for the faces of u, 1 for those of v

        px, py: positions of the faces [m]; h: size of a cell around the body [m]
        """
        self._k, self.px, self.py, self._h = k, px, py, h
        self._nearest = np.full((len(px), len(py)), np.inf)
        self._owner = np.full((len(px), len(py)), -1)

    def paint(
        self,
        places: Array,
        angle: Array,
        half_thickness: Array,
        taper: Array,
        spacing: float,
        clamped: bool,
    ) -> Covered:
        """Return the coverage by the slices of a body.

        places, angle, half_thickness, taper, spacing: those of the slices
        clamped: whether the body continues before its first slice
        """
        margin = float(half_thickness.max()) + 2.0 * self._h
        box = []
        for positions, along in ((self.px, places[:, 0]), (self.py, places[:, 1])):
            first = int(np.searchsorted(positions, along.min() - margin))
            last = int(np.searchsorted(positions, along.max() + margin))
            gaps = np.diff(positions[first:last])
            assert gaps.max() < MAX_SIZE_RATIO * self._h, "it covers coarse cells"
            box += [first, last]
        slices = places, angle, half_thickness, taper, spacing, clamped
        fields = self.px, self.py, *box, self._nearest, self._owner
        covered: Covered = _paint(self._k, *slices, self._h, *fields)
        return covered


@njit(cache=True, nogil=True)
def _paint(  # pragma: no cover
    k: int,
    places: Array,
    angle: Array,
    half_thickness: Array,
    taper: Array,
    spacing: float,
    clamped: bool,
    h: float,
    px: Array,
    py: Array,
    first_i: int,
    end_i: int,
    first_j: int,
    end_j: int,
    nearest: Array,
    owner: NDArray[np.int64],
) -> Covered:
    """Return the coverage of the faces in a box.

    The first loop finds the nearest slice of each face, the second the coverage by that slice.

    nearest, owner: square of the distance to the nearest slice, and its index; infinite and −1
        before and after each call
    """
    last = places.shape[0] - 1
    cosines, sines = np.cos(angle), np.sin(angle)
    x0, y0 = px[first_i], py[first_j]
    count = 0
    for s in range(last + 1):
        x, y = places[s, 0], places[s, 1]
        c, n = cosines[s], sines[s]
        reach = max(half_thickness[s], MIN_HALF_THICKNESS * h) + h
        along_reach = spacing + (h if s in (0, last) else 0.0)
        wide, high = abs(c) * along_reach + abs(n) * reach, abs(n) * along_reach + abs(c) * reach
        i0 = max(first_i, first_i + int(np.ceil((x - wide - x0) / h)))
        i1 = min(end_i, first_i + 1 + int((x + wide - x0) / h))
        j0 = max(first_j, first_j + int(np.ceil((y - high - y0) / h)))
        j1 = min(end_j, first_j + 1 + int((y + high - y0) / h))
        for i in range(i0, i1):
            rx = px[i] - x
            for j in range(j0, j1):
                ry = py[j] - y
                if abs(rx * c + ry * n) > along_reach:
                    continue
                distance = rx * rx + ry * ry
                if distance < nearest[i, j]:
                    count += nearest[i, j] == np.inf
                    nearest[i, j] = distance
                    owner[i, j] = s
    covered = Covered(
        np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64),
        np.empty(count), np.empty(count), np.empty(count),
    )  # fmt: skip
    count = 0
    for i in range(first_i, end_i):
        for j in range(first_j, end_j):
            s = owner[i, j]
            if s < 0:
                continue
            nearest[i, j], owner[i, j] = np.inf, -1
            rx, ry = px[i] - places[s, 0], py[j] - places[s, 1]
            c, n = cosines[s], sines[s]
            along, across = rx * c + ry * n, ry * c - rx * n
            normal = c if k else n
            thinnest = MIN_HALF_THICKNESS * h * min(1.0, 2.0 * normal * normal)
            half = max(half_thickness[s] + taper[s] * along, thinnest)
            above, below = (half - across) / h, (-half - across) / h
            chi = kernel_integral(above) - kernel_integral(below)
            moment_across = kernel_moment(above) - kernel_moment(below)
            moment_along = 0.0
            if s == last or (s == 0 and not clamped):
                outwards = 1.0 if s == last else -1.0
                end = (outwards * along - 0.5 * spacing) / h
                moment_along = outwards * kernel_moment(end) * chi
                inside = 1.0 - kernel_integral(end)
                chi, moment_across = chi * inside, moment_across * inside
            if chi <= 0.0:
                continue
            covered.i[count], covered.j[count], covered.owner[count] = i, j, s
            covered.chi[count] = chi
            covered.mu1_x[count] = moment_along * c - moment_across * n
            covered.mu1_y[count] = moment_along * n + moment_across * c
            count += 1
    return Covered(
        covered.i[:count], covered.j[:count], covered.owner[:count],
        covered.chi[:count], covered.mu1_x[:count], covered.mu1_y[:count],
    )  # fmt: skip


@njit(inline="always")
def _moment_term(  # pragma: no cover
    values: Field, covered: Covered, m: int
) -> float:
    """Return μ₁ · ∇water of the m-th covered face."""
    i, j = covered.i[m], covered.j[m]
    along: float = covered.mu1_x[m] * (float(values[i + 1, j]) - float(values[i - 1, j]))
    across: float = covered.mu1_y[m] * (float(values[i, j + 1]) - float(values[i, j - 1]))
    return 0.5 * (along + across)


@njit(inline="always")
def _lever(  # pragma: no cover
    k: int, covered: Covered, m: int, places: Array, positions: Array
) -> float:
    """Return the velocity of the m-th covered face per angular velocity of its slice [m]."""
    if k == 0:
        return float(places[covered.owner[m], 1] - positions[covered.j[m]])
    return float(positions[covered.i[m]] - places[covered.owner[m], 0])


@njit(inline="always")
def _turn_moment(k: int, covered: Covered, m: int) -> float:  # pragma: no cover
    """Return −μ₁ · ∇body of the m-th covered face, per angular velocity of its slice [cells]."""
    return float(covered.mu1_y[m] if k == 0 else -covered.mu1_x[m])


@njit(cache=True)
def gather(  # pragma: no cover
    k: int,
    covered: Covered,
    velocity: Field,
    places: Array,
    positions: Array,
    mass: float,
    h: float,
    matrix: Array,
    momentum: Array,
) -> None:
    """Add the mass matrices (slices, 3, 3) and momenta (slices, 3) of the water in the slices.

    They describe the change by `impose`, so that the momentum of water and body together is
    conserved. The matrix is not symmetric: a rotating body moves the water of a cell at the moment
    of that cell (the column), but the reaction of the cell acts on the body at its face (the row).
    Energy is therefore conserved only up to the resolution of the grid.

    k: 0 for the faces of u, 1 for those of v; velocity: that component of all faces
    positions: y of the faces of u, x of the faces of v [m]
    mass: mass of the water in a cell, one metre deep [kg]
    """
    for m in range(covered.i.size):
        s = covered.owner[m]
        lever = _lever(k, covered, m, places, positions)
        body = mass * covered.chi[m]
        turn = body * lever + mass * _turn_moment(k, covered, m) * h
        water = float(velocity[covered.i[m], covered.j[m]])
        carried = body * water - mass * _moment_term(velocity, covered, m)
        matrix[s, k, k] += body
        matrix[s, k, 2] += turn
        matrix[s, 2, k] += body * lever
        matrix[s, 2, 2] += turn * lever
        momentum[s, k] += carried
        momentum[s, 2] += lever * carried


@njit(cache=True, nogil=True)
def impose(  # pragma: no cover
    k: int,
    covered: Covered,
    velocity: Field,
    motion: Array,
    places: Array,
    positions: Array,
    h: float,
) -> float:
    """Give covered faces the velocity of the mixture, in place; return the sum of the changes.

    motion: velocities and angular velocity of the slices, shape (slices, 3)
    k, velocity, places, positions, h: as for `gather`
    """
    total = 0.0
    changes = np.empty(covered.i.size)
    for m in range(changes.size):
        s = covered.owner[m]
        turn = motion[s, 2]
        body = motion[s, k] + turn * _lever(k, covered, m, places, positions)
        water = float(velocity[covered.i[m], covered.j[m]])
        surface = _moment_term(velocity, covered, m) + turn * _turn_moment(k, covered, m) * h
        changes[m] = covered.chi[m] * (body - water) + surface
        total += changes[m]
    for m in range(changes.size):
        velocity[covered.i[m], covered.j[m]] += velocity.dtype.type(changes[m])
    return total


@njit(cache=True, nogil=True)
def add_chi(covered: Covered, chi: Field) -> None:  # pragma: no cover
    """Add the coverage by a body to χ of the faces."""
    for m in range(covered.i.size):
        chi[covered.i[m], covered.j[m]] += chi.dtype.type(covered.chi[m])


@njit(cache=True, nogil=True)
def weigh_cells(  # pragma: no cover
    k: int, covered: Covered, chi_u: Field, chi_v: Field, weight: Field
) -> None:
    """Write the weights of the divergence of the cells beside covered faces: 0 inside a body.

    A bent body is longer on one side and shorter on the other. If its inner cells were free of
    divergence, short steps would prevent it from bending.
    """
    for m in range(covered.i.size):
        for side in (-1, 0):
            i, j = covered.i[m] + (side if k == 0 else 0), covered.j[m] + (side if k else 0)
            inside = chi_u[i, j] * chi_u[i + 1, j] * chi_v[i, j] * chi_v[i, j + 1]
            weight[i, j] = weight.dtype.type(1.0) - inside


@njit(cache=True, nogil=True)
def uncover(  # pragma: no cover
    k: int, covered: Covered, chi: Field, fixed_chi: Field, weight: Field, fixed_weight: Field
) -> None:
    """Restore χ of covered faces and the weights beside them to those of the fixed body alone."""
    for m in range(covered.i.size):
        i, j = covered.i[m], covered.j[m]
        before_i, before_j = i - (k == 0), j - (k == 1)
        chi[i, j] = fixed_chi[i, j]
        weight[i, j] = fixed_weight[i, j]
        weight[before_i, before_j] = fixed_weight[before_i, before_j]
