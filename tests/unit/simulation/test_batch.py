"""Many fish at once, as arrays: the same motion and the same best beats as one by one."""

import numpy as np
import pytest
from msgspec.structs import replace

from fishd.virtual.plant.batch import FishBatch, is_possible
from fishd.virtual.plant.optimum import square_wave
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

TICK, AMPLITUDE = 0.05, 0.42
DEFAULT = PlantParameters()
FISH = {
    "default": DEFAULT,
    "slow and weakly damped": replace(DEFAULT, omega0=8.0, xi=0.6, servo_speed=4.0),
    "other forces": replace(DEFAULT, lateral_inertia_ratio=0.6, lateral_drag=0.1),
    "delay": replace(DEFAULT, servo_delay=0.075),
    "dead zone": replace(DEFAULT, servo_dead_zone=0.05),
    "backlash": replace(DEFAULT, backlash=0.1),
    "slack": replace(DEFAULT, cable_slack=0.1),
    "reaction": replace(DEFAULT, servo_reaction=3e-3),
}


@pytest.fixture(scope="module")
def swims() -> tuple[np.ndarray, np.ndarray]:
    """F_x and F_y of a batch, and of its fish one by one, shape (ticks, 2, fish)."""
    angles = AMPLITUDE * np.repeat([1.0, -1.0, 1.0, -0.5, 0.2, -1.0, 1.0], [6, 5, 4, 8, 3, 6, 6])
    batch = FishBatch(list(FISH.values()), TICK)
    together = [batch.advance(np.full(len(FISH), angle)) for angle in angles]
    alone = []
    for plant in FISH.values():
        fish = TetheredFish(plant)
        windows = [fish.advance(float(angle), TICK, 10) for angle in angles]
        alone.append([(window.thrust, window.lateral_force) for window in windows])
    return np.array(together), np.moveaxis(np.array(alone), 0, -1)


@pytest.mark.parametrize("name", FISH)
def test_a_fish_swims_in_a_batch_as_it_does_alone(
    name: str, swims: tuple[np.ndarray, np.ndarray]
) -> None:
    place = list(FISH).index(name)
    together, alone = (forces[..., place] for forces in swims)
    errors = np.sqrt(np.mean((together - alone) ** 2, axis=0))
    assert (errors < 0.02 * np.sqrt(np.mean(alone**2, axis=0))).all()


def test_the_thrusts_of_half_beats_are_those_of_periodic_square_waves() -> None:
    plants = [plant for name, plant in FISH.items() if name != "slack"]
    thrusts = FishBatch(plants, TICK).half_beat_thrusts(AMPLITUDE, 14)
    for plant, row in zip(plants, thrusts, strict=True):
        ticks = np.arange(4, 11)
        expected = [square_wave(plant, AMPLITUDE, 0.5 / (n * TICK)).thrust for n in ticks]
        assert row[ticks] == pytest.approx(expected, abs=0.01 * max(expected))


def test_long_half_beats_count_as_equal_once_they_are_too_long_for_all_fish() -> None:
    row = FishBatch([DEFAULT], TICK).half_beat_thrusts(AMPLITUDE, 20)[0]
    assert row.argmax() == 6
    assert (row[10:] == row[9]).all()


def test_a_batch_is_at_rest_after_its_best_half_beats_were_computed() -> None:
    batch, fresh = FishBatch([DEFAULT], TICK), FishBatch([DEFAULT], TICK)
    batch.half_beat_thrusts(AMPLITUDE, 8)
    angle = np.array([AMPLITUDE])
    assert np.array_equal(batch.advance(angle), fresh.advance(angle))


def test_fish_with_other_equations_are_not_possible_in_a_batch() -> None:
    assert is_possible(DEFAULT)
    assert not is_possible(replace(DEFAULT, quadratic_drag=1.0))
    assert not is_possible(replace(DEFAULT, lateral_quadratic_drag=0.1))
    assert not is_possible(replace(DEFAULT, model="other"))
