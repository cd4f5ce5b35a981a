"""Whatever goes wrong on the bus and whenever, no sample lies and the sensor recovers."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs.force_rig import STEP, ForceRig, Ticks

from fishd.core.calibration import ForceCalibration
from fishd.core.signals import Measurement
from fishd.hardware.driver import Pair
from fishd.hardware.force_sensor.window import VoltageWatch, WindowEvaluation
from fishd.hardware.settings import ForceSensorSettings

FAULTS = ("nack", "timeout", "clock-stretch", "bus-owned", "arbitration-lost", "unplugged")

codes = st.integers(-32767, 32766)
numbers = st.floats(-100, 100)
calibrations = st.builds(
    ForceCalibration, xx=numbers, xy=numbers, x0=numbers, yx=numbers, yy=numbers, y0=numbers
)
windows = st.lists(st.tuples(codes, codes), min_size=1, max_size=30)


def as_pairs(window: list[tuple[int, int]]) -> list[Pair]:
    return [
        Pair(1.0 + 3e-3 * index, 1.002 + 3e-3 * index, x * STEP, y * STEP)
        for index, (x, y) in enumerate(window)
    ]


@pytest.mark.slow
@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32),
    error_rate=st.sampled_from((0.0, 0.02, 0.2)),
    faults=st.lists(
        st.tuples(st.sampled_from(FAULTS), st.floats(1e-4, 0.3), st.floats(0.0, 0.3)), max_size=5
    ),
)
def test_each_measurement_is_right_none_is_of_the_future_and_it_recovers(
    seed: int, error_rate: float, faults: list[tuple[str, float, float]]
) -> None:
    with ForceRig(seed=seed) as rig:
        ticks = Ticks(rig.sensor())
        rig.faults.error_rate = error_rate
        found: list[Measurement | str] = []
        for name, seconds, gap in faults:
            rig.faults.inject(name, seconds)
            found += ticks.run(seconds + gap)
        rig.faults.clear()
        found += ticks.run(0.7)
    assert isinstance(found[-1], Measurement)
    newest = -math.inf
    for index, item in enumerate(found, 1):
        if isinstance(item, Measurement):
            assert newest <= item.time <= index * ticks.tick
            newest = item.time
            assert (item.fx, item.fy) == pytest.approx((0.5, -0.25), abs=6 * STEP)
            assert item.suspect == ""


@given(windows, calibrations)
def test_the_force_of_a_window_is_the_mean_of_the_forces_of_its_pairs(
    window: list[tuple[int, int]], calibration: ForceCalibration
) -> None:
    evaluation = WindowEvaluation(ForceSensorSettings(force_limit=1e4), ("F_x", "F_y"))
    measured = evaluation.measure(as_pairs(window), calibration)
    forces = [calibration.forces(x * STEP, y * STEP) for x, y in window]
    assert measured.fx == pytest.approx(sum(fx for fx, _ in forces) / len(window), abs=1e-9)
    assert measured.fy == pytest.approx(sum(fy for _, fy in forces) / len(window), abs=1e-9)
    assert measured.samples == len(window)
    assert measured.suspect == ""


@given(windows, calibrations, st.floats(0.1, 100))
def test_a_window_is_suspect_exactly_if_a_force_is_beyond_the_limit(
    window: list[tuple[int, int]], calibration: ForceCalibration, limit: float
) -> None:
    evaluation = WindowEvaluation(ForceSensorSettings(force_limit=limit), ("F_x", "F_y"))
    measured = evaluation.measure(as_pairs(window), calibration)
    forces = [calibration.forces(x * STEP, y * STEP) for x, y in window]
    assert bool(measured.suspect) == any(max(abs(fx), abs(fy)) > limit for fx, fy in forces)


@given(st.lists(windows, max_size=5))
def test_a_watch_finds_mean_and_deviation_of_all_pairs(parts: list[list[tuple[int, int]]]) -> None:
    watch = VoltageWatch(0.0, ForceCalibration())
    for part in parts:
        watch.add(as_pairs(part), "")
    sample = watch.close()
    xs = [x * STEP for part in parts for x, _ in part]
    assert sample.pairs == len(xs)
    if xs:
        mean = sum(xs) / len(xs)
        assert sample.vx == pytest.approx(mean, abs=1e-12)
        deviation = math.sqrt(sum((x - mean) ** 2 for x in xs) / len(xs))
        assert sample.vx_std == pytest.approx(deviation, abs=1e-12)


@pytest.mark.parametrize("tick", [0.005, 0.01, 0.02, 0.05, 0.1, 0.2])
def test_a_loop_of_any_tick_gets_most_of_the_samples_there_could_be(
    rig: ForceRig, tick: float
) -> None:
    ticks = Ticks(rig.sensor(tick=tick), tick)
    ticks.run(0.05)
    found = ticks.run(2.0)
    assert all(isinstance(item, Measurement) for item in found)
    assert sum(item.samples for item in found if isinstance(item, Measurement)) >= 320
