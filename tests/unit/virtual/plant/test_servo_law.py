"""Laws by which a servo approaches its instruction, beside an integration of their equations."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from fishd.virtual.plant.base import PlantState
from fishd.virtual.plant.drive_train import shortest_dwell
from fishd.virtual.plant.optimum import best_square_wave
from fishd.virtual.plant.parameters import MotorSettings, PlantParameters
from fishd.virtual.plant.servo_law import LAWS, Approach
from fishd.virtual.plant.tethered import TetheredFish

FISH = PlantParameters(servo_lag=0.15)


def accelerate(distance: float, speed: float, duration: float) -> tuple[float, float]:
    """Return distance and speed of an accelerating wheel, from short steps of its equation."""
    steps = 20_000
    h = duration / steps
    for _ in range(steps):
        wanted = math.copysign(min(1.0, math.sqrt(abs(distance))), distance)
        change = min(0.5 * h, max(-0.5 * h, wanted - speed))
        distance -= h * (speed + 0.5 * change)
        speed += change
    return distance, speed


@pytest.mark.parametrize(
    ("distance", "speed"), [(2.0, 0.0), (0.3, 0.0), (-3.0, 0.7), (0.1, 0.8), (-0.2, -0.9)]
)
def test_an_accelerating_wheel_obeys_its_equation(distance: float, speed: float) -> None:
    approach = Approach("accelerating", distance, speed)
    for duration in (0.5, 1.7, 4.0, 9.0):
        distances, speeds, _ = approach.at(np.array([duration]))
        expected = accelerate(distance, speed, duration)
        assert (distances[0], speeds[0]) == pytest.approx(expected, abs=3e-3)


@given(st.sampled_from(LAWS[1:]), st.floats(-5.0, 5.0), st.floats(-1.0, 1.0), st.floats(0.01, 8.0))
def test_an_approach_goes_on_from_any_time_in_it(
    law: str, distance: float, speed: float, time: float
) -> None:
    whole = Approach(law, distance, speed)  # type: ignore[arg-type]
    at, rates, _ = whole.at(np.array([time, time + 1.0]))
    rest = Approach(law, at[0], rates[0])  # type: ignore[arg-type]
    later, later_rates, _ = rest.at(np.array([1.0]))
    assert later[0] == pytest.approx(at[1], abs=1e-6)
    assert later_rates[0] == pytest.approx(rates[1], abs=1e-4)


@given(st.sampled_from(LAWS[1:]), st.floats(0.1, 5.0), st.floats(0.05, 0.95))
def test_the_time_to_a_distance_is_when_the_wheel_is_there(
    law: str, distance: float, share: float
) -> None:
    approach = Approach(law, distance, 0.0)  # type: ignore[arg-type]
    time = approach.time_to(share * distance)
    assert approach.at(np.array([time]))[0][0] == pytest.approx(share * distance, rel=1e-9)


@pytest.mark.parametrize("backlash", [0.0, 0.03])
def test_an_accelerating_fish_is_the_same_in_short_and_in_long_windows(backlash: float) -> None:
    plant = replace(FISH, servo_law="accelerating", backlash=backlash, servo_delay=0.012)
    whole, parts = TetheredFish(plant), TetheredFish(plant)
    for angle, ticks in ((0.4, 3), (-0.4, 2), (0.1, 1), (-0.3, 8)):
        window = whole.advance(angle, 0.05 * ticks, 1)
        short = [parts.advance(angle, 0.005, 1) for _ in range(10 * ticks)]
        assert parts.state == pytest.approx(whole.state, abs=1e-9)
        assert np.mean([w.thrust for w in short]) == pytest.approx(window.thrust, abs=1e-9)
        assert np.mean([w.lateral_force for w in short]) == pytest.approx(
            window.lateral_force, abs=1e-9
        )


@pytest.mark.parametrize("law", LAWS[1:])
def test_the_motor_pays_for_the_acceleration_of_its_rotor(law: str) -> None:
    plant = replace(FISH, servo_law=law)
    light, heavy = (
        TetheredFish(plant, motor=MotorSettings(rotor_inertia=inertia)) for inertia in (0.0, 2e-3)
    )
    powers = [
        np.mean([fish.advance(angle, 0.05, 1).power for angle in ([0.4] * 6 + [-0.4] * 6) * 3])
        for fish in (light, heavy)
    ]
    assert powers[0] < powers[1]


@pytest.mark.parametrize("law", LAWS[1:])
def test_a_servo_without_a_lag_swims_alike_by_any_law(law: str) -> None:
    hard = PlantParameters(servo_lag=0.002)
    best, expected = (
        best_square_wave(replace(hard, servo_law=name), 0.42) for name in (law, "tanh")
    )
    assert best.thrust == pytest.approx(expected.thrust, rel=0.01)
    assert best.frequency == pytest.approx(expected.frequency, rel=0.01)


def test_a_wheel_that_must_gain_its_speed_needs_a_longer_dwell() -> None:
    stiff = PlantParameters(omega0=27.0, servo_lag=0.08)
    dwells = [shortest_dwell(replace(stiff, servo_law=law), 0.2) for law in LAWS]
    assert max(dwells) == dwells[LAWS.index("accelerating")] > dwells[0]


def test_a_wheel_without_pulses_stands_still() -> None:
    fish = TetheredFish(replace(FISH, servo_law="accelerating"), PlantState())
    fish.advance(0.4, 0.05, 1)
    at = fish.state.phi
    fish.advance(None, 0.05, 1)
    assert fish.state.phi == at
