"""Faces of the grid that a body covers, and the effect of the body on the water there.

A face that a body covers in part is a mixture of body and water. The velocity of the mixture is the
average of both over a cell around the face (Maertens and Weymouth, Comput. Methods Appl. Mech. Eng.
283, 2015, doi:10.1016/j.cma.2014.09.007; here with a kernel one cell wide):

    share · body + (1 − share) · water + moment · ∇(water − body)

The moment is that of the part of the cell that is water. Without it, the method has first order:
the water next to a body moves with it, and the boundary layer is too thick by about half a cell.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fishd.virtual.swimmer.grid import Array


class Covered(NamedTuple):
    """Coverage of each face by a body, arrays of shape (nx, ny)."""

    share: Array
    """Fraction of the cell around a face that is body."""
    owner: NDArray[np.int64]
    """Index of the nearest slice of the body; −1 where nothing is covered."""
    moment_x: Array
    """First moment along x of the water in that cell, in cells."""
    moment_y: Array
    """First moment along y of the water in that cell, in cells."""


def circle(px: Array, py: Array, radius: float, h: float) -> Covered:
    """Return the coverage by a circle.

    px, py: positions of the faces relative to its centre, shapes (nx, 1) and (1, ny) [m]
    h: size of a cell [m]
    """
    distance_from_centre = np.hypot(px, py)
    reach = (distance_from_centre - radius) / h
    moment = 0.5 * np.clip(0.25 - reach**2, 0.0, None) / np.maximum(distance_from_centre, 0.5 * h)
    share = np.clip(0.5 - reach, 0.0, 1.0)
    return Covered(share, np.where(share > 0.0, 0, -1), moment * px, moment * py)


def slip(values: Array, covered: Covered) -> Array:
    """Return the contribution of the water beside surfaces to each face, moment · ∇water."""
    out = np.zeros(values.shape)
    out[1:-1] = covered.moment_x[1:-1] * (values[2:] - values[:-2])
    out[:, 1:-1] += covered.moment_y[:, 1:-1] * (values[:, 2:] - values[:, :-2])
    return 0.5 * out


@njit(inline="always")
def _beside(reach: float, h: float) -> float:  # pragma: no cover
    """Return the first moment of the water beyond a surface at the distance `reach` from a face.

    It refers to the cell around the face, and is relative to the size of the cell; 0 where the
    surface is outside the cell.
    """
    share = reach / h
    return 0.5 * max(0.25 - share * share, 0.0)


@njit(cache=True)
def paint(  # pragma: no cover
    places: Array,
    angle: Array,
    half_thickness: Array,
    taper: Array,
    spacing: float,
    h: float,
    px: Array,
    py: Array,
    clamped: bool,
) -> Covered:
    """Return the coverage of the faces at px, py by the slices of a body.

    places, angle, half_thickness, taper, spacing: those of the slices
    h: size of a cell [m]; clamped: whether the body continues beyond its first slice
    """
    nx, ny = px.size, py.size
    cover, owner = np.zeros((nx, ny)), np.full((nx, ny), -1)
    moment_x, moment_y = np.zeros((nx, ny)), np.zeros((nx, ny))
    nearest = np.full((nx, ny), np.inf)
    last = places.shape[0] - 1
    for s in range(last + 1):
        x, y = places[s, 0], places[s, 1]
        c, n = np.cos(angle[s]), np.sin(angle[s])
        reach = half_thickness[s] + h
        ends = s == 0 or s == last
        along_reach = spacing + (h if ends else 0.0)
        wide, high = abs(c) * along_reach + abs(n) * reach, abs(n) * along_reach + abs(c) * reach
        i0 = max(0, int(np.ceil((x - wide - px[0]) / h)))
        i1 = min(nx - 1, int((x + wide - px[0]) / h))
        j0 = max(0, int(np.ceil((y - high - py[0]) / h)))
        j1 = min(ny - 1, int((y + high - py[0]) / h))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                rx, ry = px[i] - x, py[j] - y
                along, across = rx * c + ry * n, ry * c - rx * n
                if abs(along) > along_reach:
                    continue
                distance = rx * rx + ry * ry
                if distance >= nearest[i, j]:
                    continue
                nearest[i, j] = distance
                half = max(half_thickness[s] + taper[s] * along, 0.0)
                above, below = min(across + 0.5 * h, half), max(across - 0.5 * h, -half)
                share = max(above - below, 0.0) / h
                beside = _beside(half - across, h) - _beside(half + across, h)
                ahead = 0.0
                if ends and not (s == 0 and clamped):
                    beyond = (along if s == last else -along) - 0.5 * spacing
                    end = min(max(0.5 - beyond / h, 0.0), 1.0)
                    ahead = (1.0 if s == last else -1.0) * _beside(beyond, h) * share
                    share, beside = share * end, beside * end
                cover[i, j] = share
                moment_x[i, j] = ahead * c - beside * n
                moment_y[i, j] = ahead * n + beside * c
                owner[i, j] = s if share > 0.0 else -1
    return Covered(cover, owner, moment_x, moment_y)


@njit(inline="always")
def _slip(  # pragma: no cover
    values: Array, moment_x: Array, moment_y: Array, i: int, j: int
) -> float:
    """Return the contribution of the water beside a surface to a face.

    The values include one more face on each side.
    """
    along: float = moment_x[i, j] * (values[i + 2, j + 1] - values[i, j + 1])
    across: float = moment_y[i, j] * (values[i + 1, j + 2] - values[i + 1, j])
    return 0.5 * (along + across)


@njit(cache=True)
def gather(  # pragma: no cover
    places: Array,
    on_u: tuple[Covered, Array, Array, Array],
    on_v: tuple[Covered, Array, Array, Array],
    mass: float,
    h: float,
) -> tuple[Array, Array]:
    """Return the mass matrices (slices, 3, 3) and momenta (slices, 3) of the water in the slices.

    They describe the change by `impose`, so that the momentum of water and body together is
    conserved. The matrix is not symmetric: a rotating body moves the water of a cell at the moment
    of that cell (the column), but the reaction of the cell acts on the body at its face (the row).
    Energy is therefore conserved only up to the resolution of the grid.

    on_u, on_v: coverage, velocities of these faces and one more on each side, positions
    mass: mass of the water in a cell, one metre deep [kg]
    """
    matrix, momentum = np.zeros((places.shape[0], 3, 3)), np.zeros((places.shape[0], 3))
    (cover, owner, moment_x, moment_y), speed, px, py = on_u
    for i in range(px.size):
        for j in range(py.size):
            s = owner[i, j]
            if s < 0:
                continue
            m, lever = mass * cover[i, j], places[s, 1] - py[j]
            turn = m * lever + mass * moment_y[i, j] * h
            carried = m * speed[i + 1, j + 1] - mass * _slip(speed, moment_x, moment_y, i, j)
            matrix[s, 0, 0] += m
            matrix[s, 0, 2] += turn
            matrix[s, 2, 0] += m * lever
            matrix[s, 2, 2] += turn * lever
            momentum[s, 0] += carried
            momentum[s, 2] += lever * carried
    (cover, owner, moment_x, moment_y), speed, px, py = on_v
    for i in range(px.size):
        for j in range(py.size):
            s = owner[i, j]
            if s < 0:
                continue
            m, lever = mass * cover[i, j], px[i] - places[s, 0]
            turn = m * lever - mass * moment_x[i, j] * h
            carried = m * speed[i + 1, j + 1] - mass * _slip(speed, moment_x, moment_y, i, j)
            matrix[s, 1, 1] += m
            matrix[s, 1, 2] += turn
            matrix[s, 2, 1] += m * lever
            matrix[s, 2, 2] += turn * lever
            momentum[s, 1] += carried
            momentum[s, 2] += lever * carried
    return matrix, momentum


@njit(cache=True)
def impose(  # pragma: no cover
    velocity: Array,
    places: Array,
    covered: Covered,
    before: Array,
    ahead: Array,
    cross_positions: Array,
    h: float,
    is_u: bool,
) -> None:
    """Set the velocity of the covered faces to that of their slice, in place in `ahead`.

    before: previous `ahead`, with one more face on each side
    other: y of the faces for u, x of the faces for v [m]
    """
    cover, owner, moment_x, moment_y = covered
    for i in range(owner.shape[0]):
        for j in range(owner.shape[1]):
            s = owner[i, j]
            if s < 0:
                continue
            turn = velocity[s, 2]
            if is_u:
                slice_velocity = velocity[s, 0] + turn * (places[s, 1] - cross_positions[j])
                bend = turn * moment_y[i, j] * h
            else:
                slice_velocity = velocity[s, 1] + turn * (cross_positions[i] - places[s, 0])
                bend = -turn * moment_x[i, j] * h
            slip = _slip(before, moment_x, moment_y, i, j) + bend
            ahead[i, j] += cover[i, j] * (slice_velocity - before[i + 1, j + 1]) + slip
