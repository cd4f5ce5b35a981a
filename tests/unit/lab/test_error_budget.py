"""Errors of gain and rotation of the force sensor in the interval of a thrust."""

import math

import pytest
from msgspec.structs import replace

from fishd.config import load
from fishd.core.calibration import EXACT, ForceCalibration
from fishd.lab.compare import LiveComparison
from fishd.lab.compare.survey import harsh
from fishd.lab.error_budget import (
    Thrust,
    budget,
    format_thrust,
    warn_of_unknown_calibration,
)
from fishd.lab.measurement import ThrustMeasurement, measure
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import simulate

GAIN_ERROR = 0.02
KNOWN = ForceCalibration(
    xx=1.0 + GAIN_ERROR,
    covariance_x=((1.5 * GAIN_ERROR / 1.96) ** 2, 0.0, 0.0),
    covariance_y=(0.0, 0.0, 0.0),
    loads=9,
)
"""Calibration of a sensor of 1 N/V: its gain is off by 2 %, with an interval of ± 3 %."""


def measure_swing(
    *overrides: str, calibration: ForceCalibration | None = None
) -> ThrustMeasurement:
    with VirtualSession(load(None, overrides), calibration) as rig:
        return measure(rig, "swing", {}, 30.0)


def test_a_gain_error_is_within_the_total_interval_and_its_part_is_named() -> None:
    measurement, truth = measure_swing(calibration=KNOWN), simulate(load(), "swing", {}).mean_thrust
    relative = 0.03 / (1.0 + GAIN_ERROR)
    assert measurement.calibration_ci95 == pytest.approx(relative * measurement.thrust)
    both = math.hypot(measurement.thrust_ci95, measurement.calibration_ci95)
    assert measurement.total_ci95 == pytest.approx(both)
    assert measurement.thrust_ci95 < abs(measurement.thrust - truth) < measurement.total_ci95
    report = measurement.summary()
    assert report.power is not None
    expected = measurement.total_ci95 / report.power
    assert report.thrust_per_watt_total_ci95 == pytest.approx(expected, rel=1e-3)


def test_the_sensor_of_a_simulated_fish_is_exact() -> None:
    measurement = measure_swing()
    assert (measurement.calibration_ci95, measurement.total_ci95, measurement.rotation) == (
        0.0,
        measurement.thrust_ci95,
        0.0,
    )


@pytest.mark.parametrize("angle", [0.05, -0.17])
def test_a_rotation_that_no_load_has_shown_is_seen_in_the_swim_and_covered(angle: float) -> None:
    quiet = ("simulation.noise=1e-5", f"simulation.rotation={angle}")
    measurement, truth = measure_swing(*quiet), simulate(load(), "swing", {}).mean_thrust
    assert measurement.rotation == pytest.approx(angle, abs=0.003)
    assert truth - measurement.thrust == pytest.approx((1.0 - math.cos(angle)) * truth, rel=0.1)
    error = truth - measurement.thrust
    assert measurement.thrust_ci95 < error < measurement.total_ci95 < 0.02 * truth


@pytest.mark.slow
@pytest.mark.parametrize("seed", [700, 703])
def test_delay_backlash_and_drift_turn_no_sensor_and_hide_no_rotation(seed: int) -> None:
    fish = harsh(seed).overrides
    assert measure_swing(*fish, "simulation.rotation=0").rotation == 0.0
    assert measure_swing(*fish, "simulation.rotation=0.1").rotation == pytest.approx(0.1, abs=0.005)


def test_a_hum_and_a_fin_at_rest_turn_no_sensor() -> None:
    assert measure_swing("simulation.noise=0.02", "simulation.drift=5e-3").rotation == 0.0
    with VirtualSession(load()) as rig:
        assert measure(rig, "hold", {}, 30.0).rotation == 0.0


def test_without_a_known_calibration_no_total_is_claimed() -> None:
    old = replace(KNOWN, covariance_x=None)
    assert budget(old, 0.025, 1e-4) == (None, None)
    unknown = Thrust(thrust=0.025, thrust_ci95=1e-4)
    shown = format_thrust(unknown, "N")
    assert shown.endswith("± 0.10 mN (statistical ± 0.10, calibration unknown)")
    shown = format_thrust(unknown, "V")
    assert shown.endswith("mV (statistical ± 0.10, calibration none)")
    assert "the uncertainty of the gains" in warn_of_unknown_calibration(unknown, "N")
    assert "not calibrated: forces are in V" in warn_of_unknown_calibration(unknown, "V")
    assert not warn_of_unknown_calibration(replace(unknown, calibration_ci95=0.0), "N")


def test_more_runs_do_not_make_the_part_of_the_calibration_smaller() -> None:
    with VirtualSession(load(), KNOWN) as rig:
        live = LiveComparison(rig, ["swing"])
        live.swim(21.0, runs=3)
    (standing,) = live.standings()
    assert standing.calibration_ci95 == pytest.approx(0.03 / 1.02 * standing.thrust, rel=1e-3)
    both = math.hypot(standing.thrust_ci95, standing.calibration_ci95)
    assert standing.total_ci95 == pytest.approx(both)


def test_a_tail_beat_to_one_side_counts_with_the_cross_term() -> None:
    turned = replace(EXACT, covariance_x=(0.0, 0.0, (0.02 / 1.96) ** 2))
    assert budget(turned, 0.025, 0.0).total_ci95 == 0.0
    assert budget(turned, 0.025, 0.0, lateral=0.01).total_ci95 == pytest.approx(0.02 * 0.01)
    assert budget(EXACT, 0.025, 0.0, 0.01, 0.1).total_ci95 == pytest.approx(
        abs((math.cos(0.1) - 1.0) * 0.025 + math.sin(0.1) * 0.01)
    )
