"""Natural frequency and damping of a swimmer from steps of its muscles."""

import numpy as np
import pytest
from rigs.documents import ROOT

from fishd.config import load
from fishd.lab.swimmer import step_response
from fishd.lab.swimmer.step_response import fit, response, swim_step

TIMES = np.arange(1, 601) * 2e-3


@pytest.mark.parametrize("xi", [1e-3, 0.2, 1.2, 2.0, 5.0])
def test_the_oscillator_of_a_response_is_found(xi: float) -> None:
    fitted = fit(0.2, TIMES, response(TIMES, 12.5, xi, 0.03))
    assert (fitted.omega0, fitted.xi, fitted.angle) == pytest.approx((12.5, xi, 0.03), rel=1e-4)
    assert fitted.misfit < 1e-5


def test_a_response_is_the_solution_of_its_equation() -> None:
    angle = response(TIMES, 12.5, 1.2, 0.03)
    rate = np.gradient(angle, TIMES)
    left = np.gradient(rate, TIMES) + 1.2 * 12.5 * rate + 12.5**2 * (angle - 0.03)
    assert np.abs(left[2:-2]).max() < 1e-3 * 12.5**2 * 0.03


def test_noise_of_a_response_is_its_misfit() -> None:
    noise = 3e-4 * np.random.default_rng(1).standard_normal(len(TIMES))
    assert fit(0.2, TIMES, response(TIMES, 12.5, 1.2, 0.03) + noise).misfit == pytest.approx(
        0.01, rel=0.1
    )


@pytest.mark.slow
@pytest.mark.parametrize("activation", [0.02, 1.0])
def test_the_default_swimmer_has_the_natural_frequency_and_the_damping_of_the_robot(
    activation: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The paper matches its body to the robot's ω₀ = 12.5 rad/s and ξ = 1.2."""
    monkeypatch.setattr(step_response, "PERIODS", 1.8)  # after which the tail hardly moves
    settings = load(ROOT / "config" / "swimmer.yaml").swimmer
    fitted = fit(activation, *swim_step(settings, activation))
    assert fitted.omega0 == pytest.approx(12.5, abs=0.3)
    assert fitted.xi == pytest.approx(1.2, abs=0.15)
    assert fitted.misfit < 0.01
