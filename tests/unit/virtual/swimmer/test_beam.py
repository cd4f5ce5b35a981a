"""Body alone: its bend agrees with the theory of beams, also for large bends."""

import numpy as np
import pytest

from fishd.virtual.swimmer.beam import Beam, Profile
from fishd.virtual.swimmer.grid import Array

LENGTH, HALF, EI, DENSITY = 0.2, 1e-3, 3e-3, 1000.0


def even(value: float) -> Profile:
    return lambda X: np.full_like(X, value)


def beam(*, clamped: bool = False, segments: int = 40) -> Beam:
    """Return a uniform beam."""
    return Beam(LENGTH, even(HALF), even(EI), segments, 1e-3, density=DENSITY, clamped=clamped)


def mass(body: Beam) -> Array:
    """Return the mass matrix of a straight beam in vacuum."""
    moves = body.motion(np.zeros(body.slices)).reshape(-1, body.size)
    return moves.T @ (body.excess.ravel()[:, None] * moves)


def test_a_free_beam_rings_at_the_frequencies_of_euler_and_bernoulli() -> None:
    body = beam()
    squares = np.sort(np.linalg.eigvals(np.linalg.solve(mass(body), body.K)).real)
    assert squares[:3] == pytest.approx(0.0, abs=1e-3 * squares[3])
    line = DENSITY * 2.0 * HALF
    asked = np.array([22.3733, 61.6728, 120.903]) * np.sqrt(EI / line) / LENGTH**2
    assert np.sqrt(squares[3:6]) == pytest.approx(asked, rel=0.01)


def test_muscles_that_ask_for_an_even_curvature_bend_it_to_an_arc() -> None:
    body, curvature = beam(clamped=True), 8.0
    q = np.zeros(body.size)
    force = body.drive(even(curvature))
    q[3:] = np.linalg.solve(body.K[3:, 3:], force[3:])
    places, angle = body.shape(q)
    assert angle == pytest.approx(curvature * body.X)
    radius = np.hypot(places[:, 0], places[:, 1] - 1.0 / curvature)
    assert radius == pytest.approx(1.0 / curvature, rel=1e-3)


def test_slices_move_as_their_places_change() -> None:
    body = beam(segments=6)
    random = np.random.default_rng(2)
    body.q[:] = 0.3 * random.normal(size=body.size)
    rate, little = random.normal(size=body.size), 1e-6
    ends = (body.shape(body.q + sign * little * rate) for sign in (1.0, -1.0))
    (ahead, turned), (behind, turned_back) = ends
    velocity = body.motion(body.shape(body.q)[1]) @ rate
    assert velocity[:, :2] == pytest.approx((ahead - behind) / (2.0 * little), abs=1e-6)
    assert velocity[:, 2] == pytest.approx((turned - turned_back) / (2.0 * little), abs=1e-6)


def test_a_couple_and_the_muscles_exert_no_net_force() -> None:
    body = beam()
    for forces in (body.couple(), body.drive(lambda X: 3.0 + 20.0 * X)):
        assert forces[:2] == pytest.approx(0.0)
    assert body.couple()[2:].sum() == pytest.approx(1.0)
    assert body.drive(even(2.0))[2:].sum() == pytest.approx(0.0, abs=1e-15)


def test_bending_energy_is_that_of_an_arc() -> None:
    body = beam()
    body.q[2:] = np.linspace(0.0, 1.5, body.segments + 1)
    energy = 0.5 * body.q @ body.K @ body.q
    assert energy == pytest.approx(0.5 * EI * (1.5 / LENGTH) ** 2 * LENGTH)
