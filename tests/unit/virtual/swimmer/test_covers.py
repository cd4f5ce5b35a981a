"""Coverage of faces by a body: its area, its kernel, and the water beside its surface."""

from typing import NamedTuple

import numpy as np
import pytest

from fishd.virtual.swimmer.covers import (
    Covered,
    Painter,
    circle,
    kernel_integral,
    kernel_moment,
)
from fishd.virtual.swimmer.grid import Array

H = 1e-3
PX, PY = np.arange(-0.02, 0.05, H), np.arange(-0.03, 0.03, H)
CENTRE = int(np.argmin(np.abs(PY)))


class Dense(NamedTuple):
    """Coverage as arrays of all faces."""

    chi: Array
    mu1_x: Array
    mu1_y: Array

    @classmethod
    def of(cls, covered: Covered) -> "Dense":
        parts = np.zeros((3, len(PX), len(PY)))
        parts[:, covered.i, covered.j] = covered.chi, covered.mu1_x, covered.mu1_y
        return cls(*parts)


def paint(
    half: float, *, angle: float = 0.0, length: float = 0.03, y: float = 0.0, clamped: bool = False
) -> Covered:
    """Return the coverage by a straight body from the origin."""
    along = np.arange(0.25 * H, length, 0.5 * H)
    direction = np.array([np.cos(angle), np.sin(angle)])
    places: Array = along[:, None] * direction + np.array([0.0, y])
    thick = np.full(len(along), half)
    angles = np.full(len(along), angle)
    return Painter(0, PX, PY, H).paint(places, angles, thick, 0.0 * thick, 0.5 * H, clamped)


def test_the_kernel_has_the_integral_and_the_moment_of_a_cosine() -> None:
    r = np.linspace(-1.0, 1.0, 2001)
    kernel = 0.5 * (1.0 + np.cos(np.pi * r))
    for above in (-1.5, -0.7, 0.0, 0.3, 1.2):
        is_above = r > above
        part = np.trapezoid(kernel * is_above, r)
        moment = np.trapezoid(r * kernel * is_above, r)
        assert 1.0 - kernel_integral(above) == pytest.approx(part, abs=1e-3)
        assert kernel_moment(above) == pytest.approx(moment, abs=1e-3)


@pytest.mark.parametrize("half", [5e-4, 4e-3])
@pytest.mark.parametrize("angle", [0.3, -1.0])
@pytest.mark.parametrize("y", [0.0, 3e-4])
def test_a_body_covers_its_own_area(half: float, angle: float, y: float) -> None:
    covered = paint(half, angle=angle, y=y)
    assert covered.chi.sum() * H**2 == pytest.approx(2.0 * half * 0.03, rel=0.03)


def test_a_circle_covers_its_own_area() -> None:
    covered = circle(PX - 1e-4, PY + 2e-4, 0.01, H)
    assert covered.chi.sum() * H**2 == pytest.approx(np.pi * 0.01**2, rel=2e-3)


def test_inside_all_is_body_and_outside_none() -> None:
    covered = Dense.of(paint(4e-3))
    middle = int(np.argmin(np.abs(PX - 0.015)))
    assert covered.chi[middle, CENTRE - 3 : CENTRE + 4] == pytest.approx(1.0)
    assert covered.chi[middle, [CENTRE - 5, CENTRE + 5]] == pytest.approx(0.0, abs=1e-9)
    assert covered.mu1_y[middle, CENTRE] == 0.0


def test_the_water_beside_a_surface_lies_outwards() -> None:
    covered = Dense.of(paint(4e-3, y=2e-4))  # above at 4.2 mm, below at −3.8 mm
    middle = int(np.argmin(np.abs(PX - 0.015)))
    for side, reach in ((1, 0.2), (-1, -0.2)):
        face = middle, CENTRE + 4 * side
        assert covered.chi[face] == pytest.approx(kernel_integral(reach))
        assert covered.mu1_y[face] == pytest.approx(side * kernel_moment(reach))
    assert np.abs(covered.mu1_x[middle]).max() == 0.0
    round_one = Dense.of(circle(PX, PY, 0.01, H))
    outwards = round_one.mu1_x * PX[:, None] + round_one.mu1_y * PY[None]
    assert outwards.min() > -1e-15
    assert outwards.max() > 0.0


def test_a_thin_body_has_water_on_both_sides_of_a_face() -> None:
    covered = Dense.of(paint(1e-4))
    middle = int(np.argmin(np.abs(PX - 0.015)))
    assert covered.chi[middle, CENTRE] == pytest.approx(2.0 * kernel_integral(0.1) - 1.0)
    assert covered.mu1_y[middle, CENTRE] == pytest.approx(0.0, abs=1e-12)


def test_a_clamped_root_has_no_surface_at_its_end() -> None:
    loose, clamped = Dense.of(paint(4e-3)), Dense.of(paint(4e-3, clamped=True))
    first = int(np.argmin(np.abs(PX)))
    assert loose.chi[first, CENTRE] == pytest.approx(0.5)
    assert clamped.chi[first, CENTRE] == pytest.approx(1.0)


def test_faces_at_unequal_distances_are_refused() -> None:
    stretched = PX * (1.0 + 0.02 * np.abs(PX) / 0.05)
    places = np.array([[0.0, 0.0], [0.01, 0.0]])
    with pytest.raises(AssertionError, match="coarse"):
        Painter(0, stretched, PY, H).paint(
            places, np.zeros(2), np.full(2, 4e-3), np.zeros(2), 0.01, clamped=False
        )


def find_wall(surface: float, diffusion: float) -> float:
    """Return where the water of a steady shear beside a body at rest appears to stand still.

    It is relative to the surface, positive outside [cells].

    surface: place of the surface above a face [cells]; diffusion: ν Δt/h²
    """
    y = np.arange(-6.0, 40.0)
    size = len(y)
    chi = np.array([kernel_integral(surface - face) for face in y])
    mu1 = np.array([kernel_moment(surface - face) for face in y])
    above, below = np.eye(size, k=1), np.eye(size, k=-1)
    diffuse = np.eye(size) + diffusion * (above + below - 2.0 * np.eye(size))
    mix = np.diag(1.0 - chi) + 0.5 * mu1[:, None] * (above - below)
    system = np.eye(size) - mix @ diffuse
    system[[0, -1]] = np.eye(size)[[0, -1]]
    u = np.linalg.solve(system, np.eye(size)[-1])
    return float(y[-1] - u[-1] / (u[-1] - u[-2]) - surface)


@pytest.mark.parametrize(
    ("diffusion", "wander", "mean"),
    [(0.0005, 0.26, 0.02), (0.0016, 0.23, 0.05), (0.0032, 0.21, 0.07), (0.0064, 0.21, 0.09)],
)
def test_the_wall_that_water_feels_stays_near_the_surface_as_that_sweeps_a_cell(
    diffusion: float, wander: float, mean: float
) -> None:
    """A kernel without a slope, one cell wide, has 0.56 and 0.20."""
    offsets = [find_wall(surface, diffusion) for surface in np.arange(0.0, 1.0, 0.125)]
    assert max(offsets) - min(offsets) < wander
    assert abs(float(np.mean(offsets))) < mean
