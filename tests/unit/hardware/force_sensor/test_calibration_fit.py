"""Fit of known loads: accuracy of the result, and refused loads."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fishd.hardware.force_sensor.calibration_fit import (
    MAX_CONDITION,
    Load,
    PoorLoads,
    check,
    fit,
    missing_loads,
)

PLAN = [(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.3), (0.0, -0.3)]

gains = st.floats(0.2, 20.0)
crosstalk = st.floats(-0.3, 0.3)
zeros = st.floats(-2.0, 2.0)


def measured_loads(
    plan: list[tuple[float, float]],
    sensor: "np.ndarray",
    zero: tuple[float, float] = (0.0, 0.0),
    noise: float = 0.0,
    seed: int = 0,
) -> list[Load]:
    """Return the loads as a sensor with V = S·F + zero measures them; noise [V, rms]."""
    random = np.random.default_rng(seed)
    voltages = np.array(plan) @ sensor.T + zero + noise * random.standard_normal((len(plan), 2))
    return [Load(*force, *v) for force, v in zip(plan, voltages.tolist(), strict=True)]


def sensor(gx: float, gy: float, cx: float = 0.0, cy: float = 0.0) -> "np.ndarray":
    return np.array([[gx, cx * gx], [cy * gy, gy]])


@given(gains, gains, crosstalk, crosstalk, zeros, zeros)
def test_without_noise_the_sensor_is_recovered_to_the_last_digits(
    gx: float, gy: float, cx: float, cy: float, x0: float, y0: float
) -> None:
    loads = measured_loads(PLAN, sensor(gx, gy, cx, cy), (x0, y0))
    if np.linalg.cond(sensor(gx, gy, cx, cy)) > 0.5 * MAX_CONDITION:
        return
    calibration = fit(loads).calibration
    for load in loads:
        assert calibration.forces(load.vx, load.vy) == pytest.approx((load.fx, load.fy), abs=1e-9)
    assert calibration.residual < 1e-9
    assert calibration.loads == 5


@given(crosstalk, crosstalk, st.integers(0, 2**32 - 1))
def test_with_noise_it_is_recovered_as_well_as_can_be(cx: float, cy: float, seed: int) -> None:
    noise = 1e-4
    loads = measured_loads(PLAN * 8, sensor(1.0, 1.0, cx, cy), (0.5, -0.5), noise, seed)
    fitted = fit(loads)
    found = fitted.calibration
    matrix = np.array([[found.xx, found.xy], [found.yx, found.yy]])
    # Six standard errors: 16 loads of 0.2 N and more along each axis, and a matrix of norm < 2.
    tolerance = 6 * 2 * 2 * noise / (0.2 * math.sqrt(16))
    assert np.abs(matrix - np.linalg.inv(sensor(1.0, 1.0, cx, cy))).max() < tolerance
    assert 0.2 * noise < fitted.calibration.residual < 5 * noise
    errors = np.array(fitted.errors)
    assert fitted.calibration.residual == pytest.approx(np.sqrt(np.mean(errors**2)))


@pytest.mark.parametrize(
    ("weight", "thread", "noise"),
    [(0.02, 0.0, 0.0), (0.0, 0.03, 0.0), (0.0, 0.0, 2e-3), (0.01, 0.0, 1e-3)],
)
def test_the_covariance_holds_the_true_gains_whatever_is_wrong_with_the_loads(
    weight: float, thread: float, noise: float
) -> None:
    """weight: relative error of each load; thread: error of its direction [rad]; noise [N]; rms"""
    plan = [*PLAN, *PLAN[1:]] if weight and noise else PLAN
    random = np.random.default_rng(7)
    true = sensor(2.0, 1.5, 0.1, 0.1)
    missed = np.zeros(3)
    for _ in range(300):
        planned = np.array(plan)
        scale, turn = random.standard_normal((2, len(plan), 1)) * [[[weight]], [[thread]]]
        hung = planned * (1.0 + scale) + turn * planned[:, ::-1] * [-1.0, 1.0]
        volts = (hung + noise * random.standard_normal(hung.shape)) @ true.T + [0.3, -0.2]
        loads = [Load(*f, *v) for f, v in zip(plan, volts.tolist(), strict=True)]
        calibration = fit(loads).calibration
        for index, (fx, fy) in enumerate(((1.0, 0.0), (0.0, 1.0), (1.0, 0.3))):
            vx, vy = true @ (fx, fy)
            ci95 = calibration.thrust_ci95(fx, fy)
            missed[index] += abs(calibration.xx * vx + calibration.xy * vy - fx) > ci95
    assert (missed <= 0.08 * 300).all()  # 5 % are expected


def test_an_error_that_all_loads_share_is_in_the_covariance_as_it_is_told() -> None:
    forces = measured_loads(PLAN, sensor(2, 1, 0.1))
    loads = [Load(1.02 * f.fx, 1.02 * f.fy, f.vx, f.vy) for f in forces]
    calibration = fit(loads, 0.03).calibration
    assert calibration.thrust_ci95(1.0) == pytest.approx(0.03)
    assert calibration.thrust_ci95(0.5, 0.2) == pytest.approx(0.015)  # a factor for both axes
    assert fit(loads).calibration.thrust_ci95(1.0) == pytest.approx(0.0, abs=1e-9)


def test_the_error_of_each_load_points_at_the_one_that_was_entered_wrongly() -> None:
    diagonal = [(0.1, 0.1), (-0.1, 0.1), (0.1, -0.1), (-0.1, -0.1)]
    loads = measured_loads([*PLAN, *diagonal], sensor(1, 1))
    loads[3] = loads[3]._replace(fy=0.35)
    errors = [math.hypot(*error) for error in fit(loads).errors]
    assert errors.index(max(errors)) == 3


def test_a_fit_that_leaves_a_fifth_of_the_loads_is_refused_by_the_name_of_the_worst() -> None:
    loads = measured_loads([*PLAN, *PLAN], sensor(1, 1))
    loads[1] = loads[1]._replace(vx=-loads[1].vx)
    with pytest.raises(PoorLoads, match=r"residual is \d\d% of them .* measure b again first"):
        check(fit(loads), loads, "abcdefghij")


def test_the_condition_number_is_one_for_a_symmetric_sensor_and_the_ratio_of_gains_else() -> None:
    cross = [(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.2), (0.0, -0.2)]
    assert fit(measured_loads(cross, sensor(2, 2))).calibration.condition == pytest.approx(1.0)
    assert fit(measured_loads(cross, sensor(1, 8))).calibration.condition == pytest.approx(8.0)


@pytest.mark.parametrize(
    ("left_out", "name"),
    [(0, "no load at all"), (1, "along +x"), (2, "along -x"), (3, "along +y"), (4, "along -y")],
)
def test_a_plan_that_lacks_a_load_is_refused_by_the_name_of_it(left_out: int, name: str) -> None:
    plan = PLAN[:left_out] + PLAN[left_out + 1 :]
    with pytest.raises(PoorLoads, match=f"{name.replace('+', '[+]')}.* is missing"):
        fit(measured_loads(plan, sensor(1, 1)))


@given(st.floats(-3, 3), st.lists(st.floats(-1, 1), min_size=3, max_size=9))
def test_loads_on_one_line_in_any_direction_are_refused(angle: float, sizes: list[float]) -> None:
    line = [(size * math.cos(angle), size * math.sin(angle)) for size in (*sizes, 0.0, 1.0, -1.0)]
    assert missing_loads(line)
    with pytest.raises(PoorLoads):
        fit(measured_loads(line, sensor(1, 1), noise=1e-5))


def test_too_few_loads_are_counted() -> None:
    corners = [(0.0, 0.0), (0.2, 0.2), (-0.2, -0.2), (0.2, -0.2)]
    assert missing_loads(corners) == ["5 loads are needed, there are 4"]
    assert missing_loads([]) != []
    assert missing_loads(PLAN) == []


def test_channels_that_are_not_connected_or_say_the_same_are_named() -> None:
    with pytest.raises(PoorLoads, match=r"V_y moved by .* wired to force_sensor.channel_y"):
        fit(measured_loads(PLAN, sensor(1, 1e-5), noise=1e-6))
    with pytest.raises(PoorLoads, match="both channels moved together"):
        fit(measured_loads(PLAN, sensor(1, 1, 1, 1), noise=1e-5))


def test_numbers_that_are_none_are_refused() -> None:
    loads = measured_loads(PLAN, sensor(1, 1))
    with pytest.raises(PoorLoads, match="measure that load again"):
        fit([*loads, Load(0.1, 0.1, math.nan, 0.0)])
    with pytest.raises(PoorLoads, match="finite"):
        fit([*loads, Load(math.inf, 0.1, 0.0, 0.0)])
