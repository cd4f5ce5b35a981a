"""Sampler and its sensor: after any error, samples have right values and times."""

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs.force_rig import STEP, ForceRig, Ticks, take_pairs, volts

from fishd.core.calibration import ForceCalibration
from fishd.core.signals import Measurement
from fishd.hardware.driver import Pair
from fishd.hardware.force_sensor.window import VoltageWatch, WindowEvaluation
from fishd.hardware.settings import ForceSensorSettings
from fishd.virtual.pi.i2c import Write

CONFIG = 1


def record_starts(rig: ForceRig) -> list[tuple[float, int]]:
    """Return a list that gets the time and the multiplexer bits of each later conversion."""
    starts: list[tuple[float, int]] = []
    transfer = rig.device.transfer

    def recorded(address: int, messages: Any) -> list[bytes]:
        for message in messages:
            data = message.data if isinstance(message, Write) else b""
            if len(data) == 3 and data[0] == CONFIG and data[1] & 0x80:
                starts.append((rig.clock.now, data[1] >> 4 & 7))
        return transfer(address, messages)

    rig.device.transfer = recorded
    return starts


def test_the_channels_are_read_in_the_order_x_y_y_x(rig: ForceRig) -> None:
    sampler = rig.sampler()
    starts = record_starts(rig)
    for _ in range(8):
        sampler.step()
    assert [mux for _, mux in starts] == [0, 3, 3, 0, 0, 3, 3, 0]


@pytest.mark.parametrize("data_rate", [8, 128, 860])
def test_every_data_rate_gives_right_values(rig: ForceRig, data_rate: int) -> None:
    pairs = take_pairs(rig.sampler(data_rate=data_rate), rig, 2.0)
    assert len(pairs) >= 0.75 * data_rate * 2.0 / 2 * 0.7
    assert all(volts(pair) == pytest.approx((0.5, -0.25), abs=6 * STEP) for pair in pairs)


def test_after_an_error_no_conversion_begins_before_the_last_one_has_ended() -> None:
    with ForceRig(seed=3) as rig:
        sampler = rig.sampler()
        starts = record_starts(rig)
        rig.faults.error_rate = 0.05
        last_error = -1.0
        for _ in range(3000):
            errors = sampler.errors
            count = len(starts)
            sampler.step()
            if len(starts) > count:
                assert starts[count][0] - last_error >= 1.25 / 860 + 1e-3
            if sampler.errors > errors:
                last_error = rig.clock.now
    assert sampler.errors > 100


def test_no_pair_is_made_of_samples_from_before_and_after_an_error() -> None:
    with ForceRig(noise=0.0) as rig:
        sampler = rig.sampler()
        sampler.step()  # X of the first pair
        rig.faults.inject("nack")
        sampler.step()
        rig.faults.clear()
        rig.volts["A0-A1"] = 0.75
        while not sampler.samples:
            sampler.step()
        assert volts(sampler.samples[0]) == pytest.approx((0.75, -0.25), abs=STEP)


def test_a_chip_that_is_still_busy_from_before_fishd_is_waited_for(rig: ForceRig) -> None:
    rig.volts["A3"] = 1.9
    rig.chip.write(bytes((1, 0b1111_0101, 0b0000_0011)))  # A3, 8 samples per second
    sampler = rig.sampler()
    pairs = take_pairs(sampler, rig, 1.0)
    assert sampler.errors > 0
    assert all(volts(pair) == pytest.approx((0.5, -0.25), abs=6 * STEP) for pair in pairs)
    assert len(pairs) > 100


def test_a_conversion_that_ends_when_a_stuck_chip_recovers_is_not_believed(rig: ForceRig) -> None:
    """A stuck chip ignores the start, so its code is an old one of the other channel."""
    sampler = rig.sampler()
    for _ in range(200):
        rig.faults.inject("stuck-busy", 0.0047)
        pairs = take_pairs(sampler, rig, 0.02)
        assert all(volts(pair) == pytest.approx((0.5, -0.25), abs=6 * STEP) for pair in pairs)
    assert sampler.errors >= 200


FAULTS = ("nack", "timeout", "clock-stretch", "bus-owned", "arbitration-lost", "unplugged")

codes = st.integers(-32767, 32766)
numbers = st.floats(-100, 100)
NAMES = ("xx", "xy", "x0", "yx", "yy", "y0")
calibrations = st.builds(ForceCalibration, **dict.fromkeys(NAMES, numbers))
windows = st.lists(st.tuples(codes, codes), min_size=1, max_size=30)


def as_pairs(window: list[tuple[int, int]]) -> list[Pair]:
    return [
        Pair(1.0 + 3e-3 * index, 1.002 + 3e-3 * index, x * STEP, y * STEP)
        for index, (x, y) in enumerate(window)
    ]


@pytest.mark.slow
@settings(max_examples=30)
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
        results: list[Measurement | str] = []
        for name, seconds, gap in faults:
            rig.faults.inject(name, seconds)
            results += ticks.run(seconds + gap)
        rig.faults.clear()
        results += ticks.run(0.7)
    assert isinstance(results[-1], Measurement)
    newest = -math.inf
    for index, item in enumerate(results, 1):
        if isinstance(item, Measurement):
            assert newest <= item.time <= index * ticks.tick
            newest = item.time
            assert (item.fx, item.fy) == pytest.approx((0.5, -0.25), abs=6 * STEP)
            assert item.suspect is None


@given(windows, calibrations)
def test_the_force_of_a_window_is_the_mean_of_the_forces_of_its_pairs(
    window: list[tuple[int, int]], calibration: ForceCalibration
) -> None:
    evaluation = WindowEvaluation(ForceSensorSettings(force_limit=1e4), ("F_x", "F_y"), "V")
    measured = evaluation.measure(as_pairs(window), calibration)
    forces = [calibration.forces(x * STEP, y * STEP) for x, y in window]
    weights = [1.0] * len(window)
    if len(window) % 2 and len(window) > 1:
        weights[0] = weights[-1] = 0.5
    for mean, values in zip((measured.fx, measured.fy), zip(*forces, strict=True), strict=True):
        weighted = sum(w * force for w, force in zip(weights, values, strict=True))
        assert mean == pytest.approx(weighted / sum(weights), abs=1e-9)
    assert measured.samples == len(window)
    assert measured.suspect is None


@pytest.mark.parametrize("count", [2, 3, 4, 13, 14])
@pytest.mark.parametrize("y_first", [False, True])
def test_the_forces_of_a_window_are_those_at_its_mean_time(count: int, y_first: bool) -> None:
    """A force that rises by 1 N/s, in pairs that begin with x and y in turn, 3.6 ms apart."""
    pairs = []
    for index in range(count):
        first, second = 3.6e-3 * index + 0.5e-3, 3.6e-3 * index + 2.3e-3
        x, y = (second, first) if y_first != bool(index % 2) else (first, second)
        pairs.append(Pair(first - 0.5e-3, second + 0.5e-3, x, y))
    evaluation = WindowEvaluation(ForceSensorSettings(), ("F_x", "F_y"), "V")
    measured = evaluation.measure(pairs, ForceCalibration())
    assert (measured.fx, measured.fy) == pytest.approx((measured.mean_time,) * 2, abs=1e-9)
    # Without the weights, an odd number would shift them by a quarter of a pair.
    assert measured.mean_time == pytest.approx(0.5 * (pairs[0].begun + pairs[-1].time))


@pytest.mark.parametrize("count", [3, 4, 13, 14])
def test_the_span_of_a_window_has_the_curvature_of_its_samples(count: int) -> None:
    """The mean of t² over the samples is that over as many equally spaced ones in the span."""
    times = [3.6e-3 * index for index in range(count)]
    pairs = [Pair(t - 1.4e-3, t + 1.4e-3, (t - 0.9e-3) ** 2, (t + 0.9e-3) ** 2) for t in times]
    evaluation = WindowEvaluation(ForceSensorSettings(), ("F_x", "F_y"), "V")
    measured = evaluation.measure(pairs, ForceCalibration())
    middle, span = measured.mean_time, measured.span
    even = [middle + span * ((k + 0.5) / count - 0.5) for k in range(count)]
    wanted = sum(t * t for t in even) / count
    assert 0.5 * (measured.fx + measured.fy) == pytest.approx(wanted, rel=5e-3)


@given(windows, calibrations, st.floats(0.1, 100))
def test_a_window_is_suspect_exactly_if_a_force_is_beyond_the_limit(
    window: list[tuple[int, int]], calibration: ForceCalibration, limit: float
) -> None:
    evaluation = WindowEvaluation(ForceSensorSettings(force_limit=limit), ("F_x", "F_y"), "V")
    measured = evaluation.measure(as_pairs(window), calibration)
    forces = [calibration.forces(x * STEP, y * STEP) for x, y in window]
    assert bool(measured.suspect) == any(max(abs(fx), abs(fy)) > limit for fx, fy in forces)


@given(st.lists(windows, max_size=5))
def test_a_watch_finds_mean_and_deviation_of_all_pairs(parts: list[list[tuple[int, int]]]) -> None:
    watch = VoltageWatch(0.0, ForceCalibration())
    for part in parts:
        watch.add(as_pairs(part), None)
    sample = watch.close()
    xs = [x * STEP for part in parts for x, _ in part]
    assert sample.pairs == len(xs)
    if xs:
        mean = sum(xs) / len(xs)
        assert sample.vx == pytest.approx(mean, abs=1e-12)
        deviation = math.sqrt(sum((x - mean) ** 2 for x in xs) / len(xs))
        assert sample.vx_std == pytest.approx(deviation, abs=1e-12)


@pytest.mark.parametrize("tick", [0.005, 0.05, 0.2])
def test_a_loop_of_any_tick_gets_most_of_the_possible_samples(rig: ForceRig, tick: float) -> None:
    ticks = Ticks(rig.sensor(tick=tick), tick)
    ticks.run(0.05)
    results = ticks.run(2.0)
    assert all(isinstance(item, Measurement) for item in results)
    assert sum(item.samples for item in results if isinstance(item, Measurement)) >= 320
