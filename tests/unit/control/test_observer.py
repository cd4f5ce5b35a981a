"""The observer: the fin velocity in rad/s from F_y and a model of the fish."""

import numpy as np
import pytest
from rigs.harness import Rig, fragile_rig

from fishd.control.estimators.observer import _exponential
from fishd.core.errors import SensorError

OBSERVER = "estimator.kind=observer"
REAL = ("simulation.offset_y=0.02", "simulation.drift=0.005")


def error(rig: Rig, seconds: float, delay: int = 0) -> float:
    """Return the rms error of the fin velocity `delay` ticks later, as a share of its rms."""
    ticks = rig.run_for(seconds)
    true = np.array([tick.alpha_rate for tick in ticks], dtype=float)[delay:]
    seen = np.array([tick.fin_velocity for tick in ticks])[: len(true)]
    return float(np.sqrt(np.mean((seen - true) ** 2) / np.mean(true**2)))


@pytest.mark.parametrize("plant", [(), ("plant.backlash=0.02", "plant.cable_slack=0.02")])
def test_the_fin_velocity_is_in_rad_per_second(plant: tuple[str, ...]) -> None:
    rig = Rig(OBSERVER, *REAL, *plant).start("square", frequency=1.7)
    rig.run_for(10)
    assert error(rig, 20) < 0.02


def test_the_fin_velocity_is_predicted_over_the_delay_of_the_servo() -> None:
    rig = Rig(OBSERVER, *REAL, "plant.servo_delay=0.1").start("square", frequency=1.25)
    rig.run_for(10)
    assert error(rig, 20, delay=2) < 0.25  # the commands of these two ticks are not known yet


def test_skipped_slots_and_a_sensor_that_fails_once_cost_little() -> None:
    rig, robot = fragile_rig(OBSERVER)
    rig.start("square", frequency=1.7)
    rig.run_for(10)
    rig.run(1, missed=3)
    robot.read_error = SensorError("not now")
    rig.run(2)
    robot.read_error = None
    rig.run(20)
    assert error(rig, 10) < 0.02


@pytest.mark.parametrize("seconds", [1.2, 600.0])
def test_after_a_suspension_of_fishd_the_observer_converges_again(seconds: float) -> None:
    rig = Rig(OBSERVER, *REAL).start("square", frequency=1.7)
    rig.run_for(10)
    rig.run(1, missed=round(seconds / rig.config.tick))
    rig.run_for(1)
    assert rig.mode == "running"
    assert error(rig, 10) < 0.02


def test_a_strongly_damped_fin_is_observed_as_well() -> None:
    rig = Rig(OBSERVER, *REAL, "tick=0.2", "plant.omega0=50", "plant.xi=14")
    rig.start("square", frequency=0.5)
    rig.run_for(10)
    rig.run(1, missed=10)
    rig.run_for(1)
    assert rig.mode == "running"
    assert error(rig, 10) < 0.1


def test_a_reversed_lateral_force_leaves_the_motion_unknown_and_the_offset_reversed() -> None:
    rig = Rig(OBSERVER, *REAL).start("square", frequency=1.7)
    observer = rig.loop.perception.estimator
    unknown = observer._covariance
    rig.run_for(10)
    offset = observer._offset
    assert offset == pytest.approx(0.02, abs=0.01)
    assert np.trace(observer._covariance) < 0.1 * np.trace(unknown)
    observer.reverse_fy()
    assert observer._offset == -offset
    np.testing.assert_array_equal(observer._covariance, unknown)


def test_the_exponential_of_a_matrix_is_that_of_scipy() -> None:
    expm = pytest.importorskip("scipy.linalg", reason="install the extra 'lab'").expm
    matrix = np.array([[0.1, -0.3], [0.4, 0.05]])
    np.testing.assert_allclose(_exponential(matrix), expm(matrix), rtol=1e-14)
