"""Coverage of faces by a body: its area, and half of a cell at its surface."""

import numpy as np
import pytest

from fishd.virtual.swimmer.covers import Covered, circle, paint
from fishd.virtual.swimmer.grid import Array

H = 1e-3
PX, PY = np.arange(-0.02, 0.05, H), np.arange(-0.03, 0.03, H)


def bar(
    half: float, *, angle: float = 0.0, length: float = 0.03, y: float = 0.0, clamped: bool = False
) -> Covered:
    """Return the coverage by a straight body from the origin."""
    along = np.arange(0.25 * H, length, 0.5 * H)
    direction = np.array([np.cos(angle), np.sin(angle)])
    places: Array = along[:, None] * direction + np.array([0.0, y])
    thick = np.full(len(along), half)
    angles = np.full(len(along), angle)
    return paint(places, angles, thick, 0.0 * thick, 0.5 * H, H, PX, PY, clamped)


@pytest.mark.parametrize("half", [2e-4, 4e-3])
@pytest.mark.parametrize("angle", [0.3, -1.0])
@pytest.mark.parametrize("y", [0.0, 3e-4])
def test_a_body_covers_its_own_area(half: float, angle: float, y: float) -> None:
    covered = bar(half, angle=angle, y=y)
    assert covered.share.sum() * H**2 == pytest.approx(2.0 * half * 0.03, rel=0.03)


def test_a_circle_covers_its_own_area() -> None:
    covered = circle(PX[:, None] - 1e-4, PY[None] + 2e-4, 0.01, H)
    assert covered.share.sum() * H**2 == pytest.approx(np.pi * 0.01**2, rel=2e-3)


def test_inside_all_is_body_and_outside_none() -> None:
    covered = bar(4e-3)
    middle = int(np.argmin(np.abs(PX - 0.015)))
    centre = int(np.argmin(np.abs(PY)))
    assert covered.share[middle, centre - 3 : centre + 4] == pytest.approx(1.0)
    assert covered.share[middle, [centre - 5, centre + 5]] == pytest.approx(0.0, abs=1e-9)
    assert covered.owner[middle, centre + 6] == -1
    assert covered.moment_y[middle, centre] == 0.0


def test_the_water_beside_a_surface_lies_outwards() -> None:
    covered = bar(4e-3, y=2e-4)  # above at 4.2 mm, below at −3.8 mm
    middle = int(np.argmin(np.abs(PX - 0.015)))
    centre = int(np.argmin(np.abs(PY)))
    assert covered.share[middle, centre + 4] == pytest.approx(0.7)
    assert covered.moment_y[middle, centre + 4] == pytest.approx(0.5 * (0.25 - 0.2**2))
    assert covered.share[middle, centre - 4] == pytest.approx(0.3)
    assert covered.moment_y[middle, centre - 4] == pytest.approx(-0.5 * (0.25 - 0.2**2))
    assert np.abs(covered.moment_x[middle]).max() == 0.0
    round_one = circle(PX[:, None], PY[None], 0.01, H)
    outwards = round_one.moment_x * PX[:, None] + round_one.moment_y * PY[None]
    assert outwards.min() == 0.0
    assert outwards.max() > 0.0


def test_a_thin_body_has_water_on_both_sides_of_a_face() -> None:
    covered = bar(1e-4)
    middle = int(np.argmin(np.abs(PX - 0.015)))
    centre = int(np.argmin(np.abs(PY)))
    assert covered.share[middle, centre] == pytest.approx(0.2)
    assert covered.moment_y[middle, centre] == pytest.approx(0.0, abs=1e-12)


def test_a_clamped_root_has_no_surface_at_its_end() -> None:
    row = int(np.argmin(np.abs(PY)))
    loose, clamped = bar(4e-3), bar(4e-3, clamped=True)
    first = int(np.argmin(np.abs(PX)))
    assert loose.share[first, row] == pytest.approx(0.5)
    assert clamped.share[first, row] == pytest.approx(1.0)
