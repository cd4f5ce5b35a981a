"""Sensors on emulated chips, through their true libraries: values, failures, and coming back."""

import itertools
import math
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import pytest
from rigs.ads1115_board import ABSENT_BUS, Board
from rigs.processes import PATIENCE, wait_until
from rigs.sensor_chips import BUS, Lsm6dsoxChip, SensorBoard, plug_thermometer

from fishd.core.clock import SystemClock, VirtualClock
from fishd.core.schema import Reading
from fishd.hardware.driver import SensorDriver, SensorSettings
from fishd.hardware.sampler import close_all
from fishd.hardware.sensors import ds18b20
from fishd.hardware.sensors.analog import AnalogInput, AnalogSettings
from fishd.hardware.sensors.ds18b20 import Ds18b20, Ds18b20Settings
from fishd.hardware.sensors.lsm6dsox import Lsm6dsox, Lsm6dsoxSettings
from fishd.hardware.sensors.sampled_readings import SampledReadings
from fishd.hardware.sensors.simulated import Simulated, SimulatedSettings

TICK = 0.05


def sampled(kind: type[Any], settings: Any, clock: Any, **options: Any) -> SampledReadings:
    """Return a sensor as `assembly` makes it, in virtual time unless `threaded`."""
    period = settings.period or TICK
    driver = kind(settings, clock, period, "sensors.mine")
    chosen: dict[str, Any] = {"threaded": False, "tick": TICK, **options}
    return SampledReadings("mine", driver, kind.declare(settings), clock, **chosen)


def values(sensor: SampledReadings, clock: VirtualClock, seconds: float = 1.0) -> dict[str, float]:
    """Return the readings after some time, without old ones."""
    until = clock.now + seconds
    while clock.now < until:
        sensor.read()
        clock.sleep(0.01)
    return {
        name: value
        for name, (time, value) in sensor.read().items()
        if clock.now - time <= sensor.stale_after
    }


def test_an_imu_gives_acceleration_and_rotation_in_its_axes_and_comes_back() -> None:
    with SensorBoard(0x6A, Lsm6dsoxChip()) as board:
        chip = board.chip
        chip.acceleration, chip.rotation = (1.0, -2.0, 9.8), (0.0, 30.0, -90.0)
        sensor = sampled(Lsm6dsox, Lsm6dsoxSettings(bus=BUS), board.clock)
        seen = values(sensor, board.clock)
        assert list(seen) == list(Lsm6dsox.readings)
        assert list(seen.values())[:3] == pytest.approx([1.0, -2.0, 9.8], abs=0.002)
        expected = [math.radians(rate) for rate in (0.0, 30.0, -90.0)]
        assert list(seen.values())[3:] == pytest.approx(expected, abs=2e-4)
        chip.plugged_in = False
        assert values(sensor, board.clock) == {}
        assert sensor.trouble.startswith(f"nothing answers at 0x6a on /dev/i2c-{BUS}: check power ")
        assert "sensors.mine.address" in sensor.trouble
        chip.plugged_in = True
        chip.reset()
        assert values(sensor, board.clock, 3.0) == pytest.approx(seen, abs=0.01)
        assert sensor.trouble is None


def test_an_imu_that_lost_its_settings_gives_no_zeros() -> None:
    with SensorBoard(0x6A, Lsm6dsoxChip()) as board:
        sensor = sampled(Lsm6dsox, Lsm6dsoxSettings(bus=BUS), board.clock)
        before = values(sensor, board.clock)
        board.chip.reset()
        assert values(sensor, board.clock, 0.1) == pytest.approx(before)
        assert sensor.trouble.endswith("lost its settings: its supply was interrupted")
        assert values(sensor, board.clock, 2.0) == pytest.approx(before)
        assert sensor.counters()["mine_reconnects"] == 1


def test_an_analogue_input_is_a_line_of_its_voltage_in_the_units_of_the_configuration() -> None:
    with Board() as board:
        board.volts[4] = 1.25  # A0
        settings = AnalogSettings(
            bus=ABSENT_BUS, address=0x48, name="flow", unit="L/min", scale=4.0, offset=-2.0
        )
        sensor = sampled(AnalogInput, settings, board.clock)
        assert sensor.declared == {"flow": Reading("L/min", "Analogue input.")}
        assert values(sensor, board.clock)["flow"] == pytest.approx(3.0, abs=1e-3)
        board.volts[4] = 5.0
        assert values(sensor, board.clock) == {}
        assert sensor.trouble.endswith(
            "is beyond ±4.096 V: choose a larger sensors.mine.full_scale"
        )


@pytest.mark.parametrize(
    ("devices", "chosen", "complaint"),
    [
        ({}, None, "is not there: check its wires, dtoverlay=w1-gpio"),
        ({"28-000000000001": 20.0}, "28-000000000002", "there is 28-000000000001"),
        (dict.fromkeys(("28-000000000001", "28-000000000002"), 20.0), None, "set sensors.mine.dev"),
        ({"28-000000000001": 85.0}, None, "loses its supply while it measures"),
    ],
)
def test_a_thermometer_that_cannot_be_read_says_why(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    devices: Mapping[str, float],
    chosen: str | None,
    complaint: str,
) -> None:
    monkeypatch.setattr(ds18b20, "DEVICES", tmp_path)
    for device, celsius in devices.items():
        plug_thermometer(tmp_path, device, celsius)
    clock = VirtualClock()
    sensor = sampled(Ds18b20, Ds18b20Settings(device=chosen), clock)
    assert values(sensor, clock, 5.0) == {}
    assert complaint in sensor.trouble


def test_a_thermometer_is_read_each_second_and_found_again_after_it_was_unplugged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ds18b20, "DEVICES", tmp_path)
    clock = VirtualClock()
    place = plug_thermometer(tmp_path, "28-0316a2795aff", 21.312)
    sensor = sampled(Ds18b20, Ds18b20Settings(), clock)
    assert values(sensor, clock, 2.0) == {"water_temperature": 21.312}
    (place / "w1_slave").unlink()
    assert values(sensor, clock, 4.0) == {}
    assert "cannot be read: No such file or directory: check its wires" in sensor.trouble
    plug_thermometer(tmp_path, "28-0316a2795aff", -0.5, good=False)
    values(sensor, clock, 2.0)
    assert "answers with errors" in sensor.trouble
    plug_thermometer(tmp_path, "28-0316a2795aff", -0.5)
    assert values(sensor, clock, 2.0) == {"water_temperature": -0.5}
    assert sensor.doubts == {"water_temperature": "water_temperature is -0.5 °C, less than 0 °C"}


def test_a_simulated_sensor_swings_about_its_value() -> None:
    clock = VirtualClock()
    settings = SimulatedSettings(name="flow", unit="m/s", value=2.0, amplitude=0.5, cycle=4.0)
    sensor = sampled(Simulated, settings, clock)
    seen = [values(sensor, clock, 0.1)["flow"] for _ in range(40)]
    assert max(seen) == pytest.approx(2.5, abs=0.01)
    assert min(seen) == pytest.approx(1.5, abs=0.01)


class Scripted(SensorDriver[SensorSettings]):
    """A sensor of another package that does what a test says."""

    Settings = SensorSettings
    readings: ClassVar = {
        "flow": Reading("m/s", "Flow.", 0.0, 10.0),
        "depth": Reading("m", "Depth."),
    }
    act: Callable[[], Any]

    def sample(self) -> Any:
        return self.act()


def scripted(clock: Any, act: Callable[[], Any], **options: Any) -> SampledReadings:
    sensor = sampled(Scripted, SensorSettings(kind="scripted"), clock, **options)
    sensor._driver.act = act  # type: ignore[attr-defined]
    return sensor


@pytest.mark.parametrize(
    ("sample", "expected", "trouble", "doubt"),
    [
        ({"flow": 1.0, "depth": math.nan}, {"flow": 1.0}, "", "depth is not a number"),
        ({"flow": 99.0, "depth": 1}, {"flow": 99.0, "depth": 1.0}, "", "flow is 99 m/s, more than"),
        ({"flow": 1.0}, {"flow": 1.0}, "", ""),
        (None, {}, "", ""),
        ({"speed": 1.0}, {}, "ValueError: it gives speed, but declares flow, depth", ""),
        ({"flow": "much"}, {}, "ValueError: flow is of type str, not one real number", ""),
        (3.0, {}, "AttributeError: ", ""),
    ],
)
def test_what_a_driver_returns_is_checked(
    sample: Any, expected: dict[str, float], trouble: str, doubt: str
) -> None:
    clock = VirtualClock()
    sensor = scripted(clock, lambda: sample)
    assert values(sensor, clock) == expected
    assert (sensor.trouble or "").startswith(trouble)
    assert bool(sensor.trouble) == bool(trouble)
    assert "".join(sensor.doubts.values()).startswith(doubt)


@pytest.mark.parametrize(("period", "expected"), [(TICK / 5, {2.0}), (2 * TICK, {0, 1, 2, 3, 4})])
def test_samples_within_a_tick_are_averaged_and_slower_ones_are_not(
    period: float, expected: set[float]
) -> None:
    clock, count = VirtualClock(), itertools.count()
    sensor = sampled(Scripted, SensorSettings(kind="scripted", period=period), clock)
    sensor._driver.act = lambda: {"flow": next(count) % 5}  # type: ignore[attr-defined]
    values(sensor, clock)
    seen = {round(values(sensor, clock, 2.0 * period)["flow"], 9) for _ in range(30)}
    assert seen == expected


def test_a_sensor_that_hangs_is_left_alone_and_keeps_neither_tick_nor_end_waiting() -> None:
    hangs, go, clock = threading.Event(), threading.Event(), SystemClock()

    def hang() -> dict[str, float]:
        hangs.set()
        go.wait(PATIENCE)
        return {"flow": 1.0}

    with ExitStack() as stack:
        sensors = [scripted(clock, hang, threaded=True) for _ in range(3)]
        stack.callback(go.set)
        assert hangs.wait(PATIENCE)
        assert [sensor.read() for sensor in sensors] == [{}, {}, {}]
        close_all(sensors)
        assert any(thread.name == "sensor-mine" for thread in threading.enumerate())
    for sensor in sensors:
        assert sensor._thread
        sensor._thread.join(PATIENCE)
        wait_until(lambda sensor=sensor: not sensor._thread.is_alive())
