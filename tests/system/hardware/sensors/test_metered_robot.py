"""A whole robot with a power meter: on a virtual Pi, in real threads, and in the configuration."""

import threading
from contextlib import ExitStack
from pathlib import Path
from typing import ClassVar

import pytest
from rigs.processes import PATIENCE, wait_until

from fishd.assembly import parts_of
from fishd.config import load
from fishd.core.clock import SystemClock
from fishd.core.errors import ConfigError
from fishd.hardware.driver import SensorDriver, SensorSettings
from fishd.hardware.sensors.sampled_readings import SampledReadings
from fishd.hardware.settings import POWER
from fishd.lab.simulation import KeepingPublisher, VirtualRun, simulate

VIRTUAL_PI = Path("config/virtual-pi.yaml")
METER = "sensors.power.kind=ina219"


def test_a_virtual_pi_tells_the_power_that_its_servo_truly_takes() -> None:
    chip = ["sensors.power_meter.kind=ina226", "virtual_pi.power_meter=ina226"]
    shunt = [f"{key}.shunt=0.02" for key in ("sensors.power_meter", "virtual_pi")]
    config = load(VIRTUAL_PI, chip + shunt)
    publisher = KeepingPublisher()
    square = {"frequency": 1.6667}
    truth = simulate(config, "square", square, 10.0, 6.0, publisher).mean_power
    powers = [tick.readings["power"] for tick in publisher.ticks[120:]]
    assert sum(powers) / len(powers) == pytest.approx(truth, rel=0.05)


def test_the_force_sensor_loses_few_samples_to_the_power_meter() -> None:
    counts = []
    for overrides in ([], ["sensors.power_meter=null"]):
        publisher = KeepingPublisher()
        with VirtualRun(load(VIRTUAL_PI, overrides), publisher) as run:
            for _ in range(50):
                run.tick()
        counts.append(sum(tick.samples for tick in publisher.ticks[1:]))
    assert counts[0] > 0.94 * counts[1]


def test_a_thread_reads_a_meter_in_real_time_and_a_read_does_not_wait_for_it() -> None:
    entered, go = threading.Event(), threading.Event()

    class Stuck(SensorDriver[SensorSettings]):
        """Meter that hangs until it may go on, and measures a constant power."""

        Settings = SensorSettings
        readings: ClassVar = {"power": POWER}

        def sample(self) -> dict[str, float]:
            entered.set()
            go.wait(PATIENCE)
            return {"power": 2.5}

    clock = SystemClock()
    driver = Stuck(SensorSettings(kind="stuck"), clock, 0.0125, "sensors.power")
    meter = SampledReadings("power", driver, driver.readings, clock, threaded=True, tick=0.05)
    with ExitStack() as stack:
        stack.callback(meter.close)
        stack.callback(go.set)
        assert entered.wait(PATIENCE)
        meter.read()
        assert meter.read() == {}
        go.set()
        wait_until(lambda: bool(meter.read()))
        assert meter.read()["power"][1] == 2.5


def test_a_meter_at_the_address_of_the_force_sensor_is_refused() -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, ["robot=pi", METER, "sensors.power.address=0x48"])
    assert str(caught.value) == (
        "--set sensors.power.address=0x48: sensors.power.address: 0x48 on /dev/i2c-1 is already "
        "the address of force_sensor: each chip needs a different address"
    )


def test_a_bus_of_its_own_is_claimed_and_one_that_the_force_sensor_has_once_only() -> None:
    for bus, expected in ((1, ["drives/i2c-1"]), (3, ["drives/i2c-1", "drives/i2c-3"])):
        config = load(None, ["robot=pi", METER, f"sensors.power.bus={bus}"])
        names = [part.name for part in parts_of(config)]
        assert [name for name in names if "i2c" in name] == expected


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("sensors.power.shunt=0.1", "sensors.power.kind: one of ads1115, ds18b20, ina219, "),
        ("sensors.power.kind=ina218", "no sensor is named 'ina218', did you mean 'ina219'?"),
    ],
)
def test_a_wrong_power_meter_is_told_in_one_line(override: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, [override])
    assert complaint in str(caught.value)
