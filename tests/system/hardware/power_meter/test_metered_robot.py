"""A whole robot with a power meter: on a virtual Pi, in real threads, and in the configuration."""

import threading
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from rigs.processes import PATIENCE, wait_until

from fishd.assembly import parts_of
from fishd.config import load
from fishd.core.clock import SystemClock
from fishd.core.errors import ConfigError, SensorError
from fishd.hardware.driver import PowerMeterDriver, PowerMeterSettings, PowerSample
from fishd.hardware.power_meter.sampled_power import SampledPower
from fishd.lab.simulation import KeepingPublisher, VirtualRun, simulate

VIRTUAL_PI = Path("config/virtual-pi.yaml")
METER = "power_meter.driver=ina219"


def test_a_virtual_pi_tells_the_power_that_its_servo_truly_takes() -> None:
    chip = ["power_meter.driver=ina226", "virtual_pi.power_meter=ina226"]
    shunt = [f"{key}.shunt=0.02" for key in ("power_meter", "virtual_pi")]
    config = load(VIRTUAL_PI, chip + shunt)
    publisher = KeepingPublisher()
    square = {"frequency": 1.6667}
    truth = simulate(config, "square", square, 10.0, 6.0, publisher).mean_power
    powers = [tick.power for tick in publisher.ticks[120:]]
    assert sum(powers) / len(powers) == pytest.approx(truth, rel=0.05)


def test_the_force_sensor_loses_few_samples_to_the_power_meter() -> None:
    counts = []
    for overrides in ([], ["power_meter=null"]):
        publisher = KeepingPublisher()
        with VirtualRun(load(VIRTUAL_PI, overrides), publisher) as run:
            for _ in range(50):
                run.tick()
        counts.append(sum(tick.samples for tick in publisher.ticks[1:]))
    assert counts[0] > 0.94 * counts[1]


def test_a_thread_reads_a_meter_in_real_time_and_a_read_does_not_wait_for_it() -> None:
    entered, go = threading.Event(), threading.Event()

    class Stuck(PowerMeterDriver[PowerMeterSettings]):
        """Meter that hangs until it may go on, and measures a constant power."""

        Settings = PowerMeterSettings
        place = "a meter"

        def open(self) -> None:
            """Do nothing."""

        def sample(self) -> PowerSample:
            entered.set()
            go.wait(PATIENCE)
            return PowerSample(self.clock.monotonic(), 2.5)

        def close(self) -> None:
            """Do nothing."""

    clock, powers = SystemClock(), list[float]()
    driver = Stuck(PowerMeterSettings(driver="stuck"), clock, 0.0125)
    meter = SampledPower(driver, clock, threaded=True, tick=0.05)
    with ExitStack() as stack:
        stack.callback(meter.close)
        stack.callback(go.set)
        assert entered.wait(PATIENCE)
        with pytest.raises(SensorError, match="a meter has not delivered"):
            meter.read(clock.monotonic())
        go.set()

        def read() -> bool:
            with suppress(SensorError):  # none yet
                powers.append(meter.read(clock.monotonic()))
            return bool(powers)

        wait_until(read)
        assert powers == [2.5]


def test_a_meter_at_the_address_of_the_force_sensor_is_refused() -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, ["robot=pi", METER, "power_meter.address=0x48"])
    assert str(caught.value) == (
        "--set power_meter.address=0x48: power_meter.address: 0x48 on /dev/i2c-1 is already the "
        "address of force_sensor: each chip needs a different address"
    )


def test_a_bus_of_its_own_is_claimed_and_one_that_the_force_sensor_has_once_only() -> None:
    for bus, expected in ((1, ["drives/i2c-1"]), (3, ["drives/i2c-1", "drives/i2c-3"])):
        config = load(None, ["robot=pi", METER, f"power_meter.bus={bus}"])
        names = [part.name for part in parts_of(config)]
        assert [name for name in names if "i2c" in name] == expected


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("power_meter.shunt=0.1", "power_meter.driver: one of ina219, ina226 is needed"),
        ("power_meter.driver=ina218", "no power-meter driver is named 'ina218', did you mean"),
    ],
)
def test_a_wrong_power_meter_is_told_in_one_line(override: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, [override])
    assert complaint in str(caught.value)
