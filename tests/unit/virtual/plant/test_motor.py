"""Power of the simulated servo: values of its data sheet, and conservation of energy."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from fishd.virtual.plant.parameters import MotorSettings, PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

PLANT = PlantParameters()
MOTOR = MotorSettings()


def mean_power(fish: TetheredFish, angles: list[float | None], window: float = 0.05) -> float:
    return float(np.mean([fish.advance(angle, window, 1).power for angle in angles]))


def test_a_servo_without_pulses_draws_its_idle_current_only() -> None:
    fish = TetheredFish(PLANT, motor=MOTOR)
    fish.advance(0.42, 0.05, 1)
    assert mean_power(fish, [None] * 10) == pytest.approx(6.0 * 0.01, rel=1e-12)


def test_a_beat_costs_what_the_equations_say_integrated_on_their_own() -> None:
    plant, motor, dt = PLANT, MOTOR, 1e-5
    fish = TetheredFish(plant, motor=motor)
    half = [0.42] * 6 + [-0.42] * 6
    mean_power(fish, half * 10)  # it has settled
    power = mean_power(fish, half)

    resistance = motor.voltage / motor.stall_current
    emf = (motor.voltage - resistance * motor.no_load_current) / plant.servo_speed
    constant = motor.stall_torque / motor.stall_current
    phi, alpha, rate = fish.state
    speed_before = plant.servo_speed * math.tanh((-0.42 - phi) / plant.servo_lag)
    energy = 0.0
    for angle in (0.42, -0.42):
        lag = (angle - phi) / plant.servo_lag
        speed = plant.servo_speed * math.tanh(lag)
        jump = motor.rotor_inertia * emf / constant * speed * (speed - speed_before)
        energy += max(0.0, jump)
        for _ in range(round(0.3 / dt)):
            lag = (angle - phi) / plant.servo_lag
            speed = plant.servo_speed * math.tanh(lag)
            slowing = -(plant.servo_speed**2) / plant.servo_lag * math.tanh(lag)
            slowing /= math.cosh(lag) ** 2
            bend = plant.coupling * phi - alpha
            torque = plant.coupling * motor.tail_inertia * plant.omega0**2 * bend
            torque += motor.rotor_inertia * slowing
            current = motor.no_load_current * speed / plant.servo_speed + torque / constant
            energy += max(0.0, (resistance * current + emf * speed) * current) * dt
            phi += speed * dt
            alpha += rate * dt
            rate += (-plant.xi * plant.omega0 * rate + plant.omega0**2 * bend) * dt
        speed_before = speed
    expected = energy / 0.6 + motor.voltage * motor.idle_current
    assert power == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("fault", [{"backlash": 0.05}, {"cable_slack": 0.05}])
def test_a_wheel_in_its_play_does_not_pay_for_the_tail(fault: dict[str, float]) -> None:
    plant = replace(PLANT, **fault)
    motors = (replace(MOTOR, tail_inertia=inertia) for inertia in (0.01, 0.0))
    heavy, none = (TetheredFish(plant, motor=motor) for motor in motors)
    small = [0.02, -0.02] * 5
    assert mean_power(heavy, small) == pytest.approx(mean_power(none, small), rel=1e-9)


def test_a_fish_without_a_motor_has_no_power() -> None:
    assert math.isnan(TetheredFish(PLANT).advance(0.42, 0.05, 1).power)
