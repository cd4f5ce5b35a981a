"""Shortest dwell from the servo and the fin of a fish."""

import math

import pytest
from msgspec.structs import replace

from fishd.config import load
from fishd.virtual.plant.drive_train import shortest_dwell
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import PlantState, TetheredFish

FISH = PlantParameters()


def test_it_is_the_time_in_which_the_wheel_has_turned_by_nine_tenths_after_the_delay() -> None:
    plant = replace(FISH, omega0=10.0, servo_delay=0.03)  # by the servo alone
    fish = TetheredFish(plant, PlantState(phi=-0.42))
    fish.advance(0.42, shortest_dwell(plant, 0.42), 1)
    assert fish.state.phi == pytest.approx(0.42 - 0.1 * 0.84, abs=1e-6)


@pytest.mark.parametrize("omega0", [5.0, 12.5, 40.0])
@pytest.mark.parametrize("delay", [0.0, 0.5])
@pytest.mark.parametrize("speed", [0.5, 1e3])
def test_it_forbids_no_best_wave_or_fast_servo(omega0: float, delay: float, speed: float) -> None:
    plant = replace(FISH, omega0=omega0, servo_delay=delay, servo_speed=speed)
    half_beat = max(math.pi / omega0, 2.0 * 0.42 / speed)
    assert 0.6 - 1e-9 <= shortest_dwell(plant, 0.42) / half_beat <= 0.8 + 1e-9


@pytest.mark.parametrize(
    ("changes", "dwell"),
    [
        ((), 0.2),
        (("tick=0.02",), 0.18),
        (("plant.servo_delay=0.08",), 0.25),
        (("plant.servo_delay=0.08", "chatter.dwell=0.1"), 0.1),
        (("plant.servo_speed=0.01",), 2.0),
        (("robot=swimmer", "tick=0.01", "plant.servo_delay=0.08"), 0.2),
    ],
)
def test_policies_get_that_of_the_section_plant_in_whole_ticks_unless_a_number_is_given(
    changes: tuple[str, ...], dwell: float
) -> None:
    assert load(None, changes).limits.dwell == dwell
