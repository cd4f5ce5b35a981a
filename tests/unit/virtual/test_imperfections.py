import math

import numpy as np
import pytest

from fishd.core.signals import Measurement
from fishd.virtual.fish import SimulatedFish
from fishd.virtual.imperfections import Imperfections, SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

TICK = 0.05
SAMPLES = 10
"""Number of samples per tick."""


def at_rest(ticks: int, tick: float = TICK, **rig: float) -> list[Measurement]:
    """Return the measurements of a fish at rest."""
    settings = SimulationSettings(sample_rate=SAMPLES / tick, **{"noise": 0.0, **rig})
    fish = SimulatedFish(PlantParameters(), settings, tick)
    return [fish.read(k * tick) for k in range(ticks)]


def test_hum_has_its_frequency_and_amplitude_in_both_forces() -> None:
    settings = SimulationSettings(noise=0.0, hum=0.003, hum_frequency=60.0, sample_rate=1000.0)
    fish = SimulatedFish(PlantParameters(), settings, 0.001)
    forces = [fish.read(0.001 * k) for k in range(1000)]
    for values in ([f.fx for f in forces], [f.fy for f in forces]):
        spectrum = np.abs(np.fft.rfft(values)) / 500.0
        assert int(np.argmax(spectrum)) == 60
        assert spectrum[60] == pytest.approx(0.003, rel=1e-6)
        assert np.sort(spectrum)[-2] < 1e-9


@pytest.mark.parametrize("frequency", [3.0, 50.0, 200.0, 400.0])
def test_a_window_has_the_mean_of_its_samples_of_the_hum(frequency: float) -> None:
    settings = SimulationSettings(noise=0.0, hum=0.01, hum_frequency=frequency)
    rig, single = Imperfections(settings, TICK), Imperfections(settings, TICK)
    apart = TICK / SAMPLES
    for k in range(5):
        end = (k + 1) * TICK
        ends = [end - TICK + (i + 1) * apart for i in range(SAMPLES)]
        samples = [single.apply(0.0, 0.0, time, apart, 1) for time in ends]
        shown = rig.apply(0.0, 0.0, end, TICK, SAMPLES)
        assert shown == pytest.approx(np.mean(samples, axis=0), abs=1e-12)


def test_a_long_conversion_has_the_mean_of_all_of_the_hum() -> None:
    settings = SimulationSettings(noise=0.0, hum=0.01)
    shown = Imperfections(settings, TICK).apply(0.0, 0.0, 1.007, 0.007)
    many = Imperfections(settings, TICK).apply(0.0, 0.0, 1.007, 0.007, 10_000)
    assert shown == pytest.approx(many, rel=1e-6)
    whole_period = Imperfections(settings, TICK).apply(0.0, 0.0, 1.02, 0.02)
    assert whole_period == pytest.approx((0.0, 0.0), abs=1e-12)


def test_spikes_are_as_frequent_as_said_and_shared_by_the_samples_of_a_window() -> None:
    seconds = 1000
    measurements = at_rest(round(seconds / TICK), spike_rate=0.5, spike_size=0.2)
    for values in ([f.fx for f in measurements], [f.fy for f in measurements]):
        spikes = [round(value / (0.2 / SAMPLES), 6) for value in values if value]
        assert all(size == int(size) for size in spikes)
        count = sum(map(abs, spikes))
        assert count == pytest.approx(0.5 * seconds, abs=4.0 * math.sqrt(0.5 * seconds))
        upwards = sum(size for size in spikes if size > 0)
        assert upwards == pytest.approx(0.5 * count, abs=2.0 * math.sqrt(count))
    together = sum(1 for f in measurements if f.fx and f.fy)
    assert together < 30  # 0.025² of the windows by chance: 12


def test_forces_are_told_in_whole_steps() -> None:
    measurements = at_rest(500, quantum=0.0005, noise=0.002)
    steps = {round(f.fx / 0.0005, 9) for f in measurements}
    assert len(steps) > 10
    assert all(step == int(step) for step in steps)


def test_heavy_tails_leave_the_rms_and_make_outliers() -> None:
    gaussian = [f.fx for f in at_rest(20_000, noise=0.001)]
    heavy = [f.fx for f in at_rest(20_000, noise=0.001, noise_freedom=3.0)]
    assert np.std(gaussian) == pytest.approx(0.001, rel=0.03)
    assert np.std(heavy) == pytest.approx(0.001, rel=0.15)
    assert sum(abs(x) > 0.004 for x in gaussian) <= 5  # 1.3 of 20 000
    assert 80 < sum(abs(x) > 0.004 for x in heavy) < 200  # 6.2e-3 of them: 124


def test_the_same_seed_gives_the_same_forces_to_the_last_bit_and_another_one_others() -> None:
    noise = {"noise": 0.001, "noise_freedom": 4.0, "hum": 0.003, "spike_rate": 1.0}
    harsh = noise | {"quantum": 1e-5, "drift_walk": 1e-4}
    first, again = (at_rest(300, seed=7, **harsh) for _ in range(2))
    assert first == again
    assert at_rest(300, seed=8, **harsh) != first
