"""Force sensor on an emulated ADS1115, through the real driver: results of the reads."""

import itertools

import pytest
from rigs.force_rig import STEP, TICK, ForceRig, Ticks, measurements

from fishd.core.calibration import ForceCalibration
from fishd.core.errors import SensorError
from fishd.core.signals import Measurement
from fishd.virtual.pi.i2c import Write

CALIBRATION = ForceCalibration(xx=2.0, xy=0.1, x0=-0.3, yx=-0.2, yy=3.0, y0=0.4)


def test_forces_are_the_calibrated_voltages(rig: ForceRig) -> None:
    measured = Ticks(rig.sensor(CALIBRATION)).next()
    assert measured.fx == pytest.approx(2.0 * 0.5 + 0.1 * -0.25 - 0.3, abs=2e-4)
    assert measured.fy == pytest.approx(-0.2 * 0.5 + 3.0 * -0.25 + 0.4, abs=3e-4)
    assert measured.suspect is None


@pytest.mark.parametrize(
    ("channel_x", "channel_y"), [("A2-A3", "A0-A1"), ("A0", "A3"), ("A0-A3", "A1-A3")]
)
def test_each_force_comes_from_its_channel(rig: ForceRig, channel_x: str, channel_y: str) -> None:
    rig.volts = {channel_x: 0.8, channel_y: 0.3}
    ticks = Ticks(rig.sensor(channel_x=channel_x, channel_y=channel_y))
    for measured in measurements(ticks.run(1.0)):
        assert (measured.fx, measured.fy) == pytest.approx((0.8, 0.3), abs=1e-3)


@pytest.mark.parametrize("full_scale", [6.144, 2.048, 0.256])
def test_every_range_gives_the_same_voltage(rig: ForceRig, full_scale: float) -> None:
    rig.volts = {"A0-A1": 0.2, "A2-A3": -0.1}
    measured = Ticks(rig.sensor(full_scale=full_scale)).next()
    assert (measured.fx, measured.fy) == pytest.approx((0.2, -0.1), abs=full_scale / 8000)


def test_a_window_of_50_ms_holds_at_least_eight_pairs() -> None:
    with ForceRig() as rig:
        windows = measurements(Ticks(rig.sensor()).run(5.0))
    assert min(measured.samples for measured in windows) >= 12
    with ForceRig(speed=100e3) as rig:
        windows = measurements(Ticks(rig.sensor()).run(5.0))[1:]  # the first also opens the chip
    assert min(measured.samples for measured in windows) >= 8


def test_a_measurement_is_of_the_window_before_its_tick() -> None:
    with ForceRig(noise=0.0) as rig:
        rig.volts["A0-A1"] = lambda t: 0.1 * t
        ticks = Ticks(rig.sensor())
        for index, measured in enumerate(measurements(ticks.run(5.0)), 1):
            now = index * TICK
            assert now - 0.01 < measured.time <= now
            # The quiet time before a read, and a last conversion that would have reached into it.
            assert measured.fx == pytest.approx(0.1 * (now - TICK / 2), abs=0.1 * 5e-3)


@pytest.mark.parametrize(
    "fault", ["nack", "timeout", "arbitration-lost", "unplugged", "stuck-busy"]
)
def test_while_the_chip_is_away_reads_raise_and_then_work_again(rig: ForceRig, fault: str) -> None:
    sensor = rig.sensor()
    ticks = Ticks(sensor)
    measurements(ticks.run(1.0))
    rig.faults.inject(fault, 2.0)
    during = ticks.run(2.0)
    assert all(isinstance(item, str) for item in during[1:])
    after = ticks.run(0.6)
    assert isinstance(after[-1], Measurement)
    for measured in measurements(ticks.run(1.0)):
        assert measured.samples >= 12
        assert (measured.fx, measured.fy) == pytest.approx((0.5, -0.25), abs=1e-3)
    counters = sensor.counters()
    assert counters["i2c_errors"] >= 5
    assert counters["i2c_reconnects"] == 1


def test_a_slow_data_rate_repeats_the_last_measurement_with_its_own_time(rig: ForceRig) -> None:
    ticks = Ticks(rig.sensor(data_rate=16))
    windows = measurements(ticks.run(3.0)[4:])
    repeated = [(a, b) for a, b in itertools.pairwise(windows) if b.samples == 0]
    assert repeated
    assert all((a.time, a.fx, a.fy) == (b.time, b.fx, b.fy) for a, b in repeated)


@pytest.mark.parametrize("data_rate", [8, 32])
def test_no_measurement_is_newer_than_its_tick_if_a_conversion_outlasts_it(data_rate: int) -> None:
    with ForceRig(noise=0.0) as rig:
        rig.volts["A0-A1"] = lambda t: 0.1 * t
        results = Ticks(rig.sensor(data_rate=data_rate)).run(5.0)
    numbered = enumerate(results, 1)
    ages = [number * TICK - f.time for number, f in numbered if not isinstance(f, str)]
    assert min(ages) >= 0.0
    assert len(ages) > 90
    assert sum(item.samples for item in results if not isinstance(item, str)) >= 2 * data_rate


def test_recalibrating_changes_the_next_read(rig: ForceRig) -> None:
    sensor = rig.sensor()
    ticks = Ticks(sensor)
    ticks.next()
    sensor.recalibrate(CALIBRATION)
    assert ticks.next().fx == pytest.approx(0.675, abs=1e-3)
    assert sensor.calibration == CALIBRATION


def test_a_watch_adds_up_the_voltages_of_its_time(rig: ForceRig) -> None:
    sensor = rig.sensor(CALIBRATION)
    ticks = Ticks(sensor)
    ticks.run(0.5)
    rig.volts["A0-A1"] = 0.6  # after the first sample of a pair
    watch = sensor.watch()
    windows = measurements(ticks.run(2.0))
    sample = watch.close()
    rig.volts["A0-A1"] = 0.9
    ticks.run(0.5)
    assert watch.close() == sample
    assert sample.pairs == sum(measured.samples for measured in windows) - 1
    assert sample.seconds == pytest.approx(2.0, abs=0.01)
    assert (sample.vx, sample.vy) == pytest.approx((0.6, -0.25), abs=1e-5)
    assert (sample.fx, sample.fy) == pytest.approx(CALIBRATION.forces(0.6, -0.25), abs=1e-4)
    assert sample.vx_std == pytest.approx(STEP, rel=0.3)
    assert sample.suspect is None


def test_a_watch_remembers_that_samples_were_suspect(rig: ForceRig) -> None:
    sensor = rig.sensor()
    watch = sensor.watch()
    ticks = Ticks(sensor)
    rig.faults.inject("clipped", 0.1)
    ticks.run(1.0)
    assert "is clipped at +2.048 V" in watch.close().suspect


def test_a_closed_sensor_can_be_closed_again_and_not_be_read(rig: ForceRig) -> None:
    sensor = rig.sensor()
    sensor.read(TICK)
    sensor.close()
    sensor.close()
    with pytest.raises(SensorError, match="is closed"):
        sensor.read(2 * TICK)


COARSE = (
    "the chip at 0x48 on /dev/i2c-1 is an ADS1015, not an ADS1115: it has 12 bits, so its step is "
    "1 mV, 16 times as coarse; replace it"
)


@pytest.mark.parametrize("threshold", [None, 0x7FF0, 0x1230, 0x8000])
@pytest.mark.parametrize(("bits", "limitations"), [(16, ()), (12, (COARSE,))])
def test_an_ads1015_is_a_limitation_whatever_another_program_wrote(
    bits: int, limitations: tuple[str, ...], threshold: int | None
) -> None:
    with ForceRig(bits=bits) as rig:
        if threshold is not None:
            rig.bus.transfer(0x48, [Write(bytes([3, *threshold.to_bytes(2, "big")]))])
        sensor = rig.sensor()
        measured = Ticks(sensor).next()
        assert sensor.limitations == limitations
    assert (measured.fx, measured.fy) == pytest.approx((0.5, -0.25), abs=1e-3)


def test_an_ads1115_in_the_place_of_an_ads1015_ends_the_limitation() -> None:
    with ForceRig(bits=12) as coarse:
        fine = ForceRig(clock=coarse.clock)
        sensor = coarse.sensor()
        ticks = Ticks(sensor)
        ticks.next()
        assert sensor.limitations == (COARSE,)
        coarse.faults.inject("unplugged")
        ticks.run(0.5)
        coarse.bus = fine.bus
        ticks.run(1.5)
        assert sensor.limitations == ()
