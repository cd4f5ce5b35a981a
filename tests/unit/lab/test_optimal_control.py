"""Optima of a fish: limits of the full equations, and an optimal command that is a square wave."""

import numpy as np
import pytest
from msgspec.structs import replace

from fishd.core.errors import ParameterError
from fishd.lab.optimum import (
    OptimalControl,
    best_square_waves,
    fast_servo,
    optimal_control,
    saturation_amplitude,
    slow_servo,
)
from fishd.virtual.plant.parameters import PlantParameters

DEFAULT = PlantParameters()


def test_a_quick_servo_reaches_the_fast_limit_at_every_amplitude() -> None:
    quick = replace(DEFAULT, servo_speed=1e4, servo_lag=1e-4)
    full, limit = best_square_waves(quick, [0.05, 0.4]), fast_servo(DEFAULT, [0.05, 0.4])
    assert full.thrust == pytest.approx(limit.thrust, rel=1e-4)
    assert full.frequency == pytest.approx(limit.frequency, rel=1e-3)
    assert full.fin_amplitude == pytest.approx(limit.fin_amplitude, rel=1e-3)


def test_a_large_amplitude_reaches_the_slow_limit() -> None:
    amplitude = [300.0 * saturation_amplitude(DEFAULT)]
    full, limit = best_square_waves(DEFAULT, amplitude), slow_servo(DEFAULT, amplitude)
    assert full.thrust == pytest.approx(limit.thrust, rel=5e-3)
    assert full.frequency == pytest.approx(limit.frequency, rel=2e-2)
    assert full.fin_amplitude == pytest.approx(limit.fin_amplitude, rel=1e-2)


def test_an_amplitude_that_is_not_positive_is_refused() -> None:
    with pytest.raises(ValueError, match="amplitudes must be positive"):
        best_square_waves(DEFAULT, [0.1, 0.0])


def is_bang_bang(control: OptimalControl) -> bool:
    return (
        control.saturated_fraction >= 0.98
        and control.costate_agreement >= 0.98
        and control.ratio == pytest.approx(1.0, abs=0.005)
        and control.frequency == pytest.approx(control.best_square.frequency, rel=0.01)
    )


def test_the_best_command_of_any_shape_is_a_square_wave() -> None:
    control = optimal_control(DEFAULT, 0.42)
    assert is_bang_bang(control)
    assert control.command[0] == pytest.approx(0.42)
    assert control.force.mean() == pytest.approx(control.thrust)
    assert np.all(control.time[1:] > control.time[:-1])


@pytest.mark.slow
@pytest.mark.parametrize(("xi", "amplitude"), [(1.2, 0.1), (1.2, 1.0), (0.05, 0.31)])
def test_it_is_one_on_other_fish_and_at_other_amplitudes(xi: float, amplitude: float) -> None:
    assert is_bang_bang(optimal_control(PlantParameters(xi=xi), amplitude))


def test_the_best_command_of_an_undamped_fin_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"plant\.xi: 0 is not possible"):
        optimal_control(PlantParameters(xi=0.0), 0.42)
