"""INA219 through its real library, and INA226, on emulated chips on a virtual bus."""

import errno
import re
from collections.abc import Iterator
from typing import Any

import pytest
from rigs.ads1115_board import ABSENT_BUS, Board

from fishd.hardware.sensors.ina import Ina, Ina219, Ina219Settings, Ina226, Ina226Settings
from fishd.hardware.sensors.sampled_readings import SampledReadings, sample_period
from fishd.virtual.pi.ina import CHIPS

TICK = 0.05


class MeterRig(Board):
    """Rig of a power meter next to an ADS1115, with a servo that takes `watts` of power."""

    def __init__(self, kind: str, shunt: float) -> None:
        super().__init__()
        self.kind, self.shunt = kind, shunt
        self.watts: Any = lambda time: 1.5
        self.meter_chip = CHIPS[kind](self.clock, self.mean, self.faults, 6.0, shunt)
        self.bus.attach(0x40, self.meter_chip)
        self.index = 0

    def mean(self, start: float, end: float) -> float:
        """Return the mean power between two times [W]."""
        steps = [start + (k + 0.5) / 200 * (end - start) for k in range(200)]
        return sum(map(self.watts, steps)) / 200

    def driver(self, **settings: Any) -> Ina[Any]:  # type: ignore[override]
        values = {"bus": ABSENT_BUS, "shunt": self.shunt, **settings}
        kind: Any = Ina219 if self.kind == "ina219" else Ina226
        chosen = (Ina219Settings if self.kind == "ina219" else Ina226Settings)(**values)
        return kind(chosen, self.clock, sample_period(kind, chosen, TICK), "sensors.power")

    def meter(self) -> SampledReadings:
        driver = self.driver()
        return SampledReadings(
            "power", driver, driver.readings, self.clock, threaded=False, tick=TICK
        )

    def tick(self, meter: SampledReadings) -> float | None:
        """Run a tick as in virtual time: let the meter sample until the tick, then read it."""
        self.index += 1
        while self.clock.monotonic() < self.index * TICK:
            meter.read()
            self.clock.sleep(1e-3)
        time, value = meter.read().get("power", (-1.0, 0.0))
        return value if self.index * TICK - time <= meter.stale_after else None


@pytest.fixture(params=[("ina219", 0.1), ("ina226", 0.01)], ids=["ina219", "ina226"])
def rig(request: pytest.FixtureRequest) -> Iterator[MeterRig]:
    with MeterRig(*request.param) as rig:
        yield rig


@pytest.mark.parametrize("watts", [1.5, -0.3])
def test_it_tells_the_power_to_a_step_of_its_own_and_what_flows_back_as_negative(
    rig: MeterRig, watts: float
) -> None:
    rig.watts = lambda time: watts
    meter = rig.meter()
    rig.tick(meter)
    step = 6.0 * rig.meter_chip.shunt_step / rig.shunt
    assert rig.tick(meter) == pytest.approx(watts, abs=step)
    meter.close()


def test_short_bursts_go_unseen_in_no_part_of_a_tick(rig: MeterRig) -> None:
    # 10 W for 2 ms in each 47 ms, which is not in phase with the ticks.
    rig.watts = lambda time: 10.0 if time % 0.047 < 0.002 else 0.0
    meter = rig.meter()
    rig.tick(meter)
    powers = [rig.tick(meter) for _ in range(400)]
    assert sum(powers) / len(powers) == pytest.approx(10.0 * 2 / 47, rel=0.03)


def test_a_meter_that_was_unplugged_is_set_up_anew(rig: MeterRig) -> None:
    meter = rig.meter()
    rig.tick(meter)
    rig.faults.inject("meter-unplugged", 1.0)
    assert [rig.tick(meter) for _ in range(10)][2:] == [None] * 8
    assert re.match(r"nothing answers at 0x40 .* of the INA2.*sensors.power", meter.trouble)
    powers = [rig.tick(meter) for _ in range(40)]
    assert powers[-1] == pytest.approx(1.5, rel=0.01)
    assert meter.counters()["power_reconnects"] == 1
    assert meter.trouble is None


@pytest.mark.parametrize(
    ("fault", "seconds", "lasts"), [("meter-unplugged", 0.005, 0.2), ("meter-brown-out", None, 1.2)]
)
def test_a_short_loss_of_its_supply_costs_no_averaging_for_longer(
    rig: MeterRig, fault: str, seconds: float | None, lasts: float
) -> None:
    meter = rig.meter()
    rig.tick(meter)
    averages = rig.meter_chip.config
    rig.clock.sleep(4e-3)  # the next sample is due after 6.25 ms
    rig.faults.inject(fault, seconds)
    assert rig.meter_chip.config != averages
    messages = set()
    for _ in range(round(lasts / TICK)):
        power = rig.tick(meter)
        messages.add(meter.trouble)
    assert all("its supply was interrupted" in line for line in messages - {None})
    assert rig.meter_chip.config == averages
    assert power == pytest.approx(1.5, rel=0.01)
    assert meter.counters()["power_reconnects"] == 1


def test_a_transfer_that_fails_while_its_supply_holds_costs_one_sample_only(rig: MeterRig) -> None:
    meter = rig.meter()
    rig.tick(meter)
    rig.clock.sleep(4e-3)  # the next sample is due after 6.25 ms
    rig.faults.inject("nack", 0.005)
    for _ in range(10):
        rig.tick(meter)
    assert meter.counters() == {"power_errors": 1, "power_reconnects": 0}


def test_a_current_beyond_the_range_is_not_believed(rig: MeterRig) -> None:
    rig.watts = lambda time: 6.0 * 40.0
    meter = rig.meter()
    assert [rig.tick(meter) for _ in range(3)] == [None] * 3
    assert meter.trouble.endswith("a smaller one is needed")


def test_a_meter_can_be_closed_twice(rig: MeterRig) -> None:
    meter = rig.meter()
    rig.tick(meter)
    meter.close()
    meter.close()


def test_another_chip_at_its_address_is_told_from_an_ina226() -> None:
    with MeterRig("ina219", 0.1) as rig:
        driver = Ina226(Ina226Settings(bus=ABSENT_BUS), rig.clock, 0.0125, "sensors.power")
        with pytest.raises(OSError, match="identifies itself as another chip") as caught:
            driver.open()
        assert caught.value.errno == errno.ENODEV
