"""Any number of sensors in the configuration, and their readings on a simulated fish."""

import sys
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest
from rigs.harness import Rig

from fishd.assembly import assemble
from fishd.config import adopt, load
from fishd.config.mistakes import find
from fishd.core.clock import VirtualClock
from fishd.core.errors import ConfigError, MissingPackage

WATER = "sensors.water={kind: ds18b20}"


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        (
            [WATER, "sensors.tank.kind=simulated"],
            "sensors.tank: its reading water_temperature is the name of a reading of sensors.water "
            "already: another name is needed, as in sensors.tank.rename",
        ),
        (
            ["sensors.a={kind: simulated, name: thrust}"],
            "sensors.a: its reading thrust is the name of a column of every tick already: another "
            "name is needed, as in sensors.a.rename",
        ),
        (
            ["sensors.a={kind: simulated, name: Flow rate}"],
            "sensors.a: its reading 'Flow rate' is not valid: a name of a to z, 0 to 9 and _, with "
            "a Reading, is needed",
        ),
        (
            ["sensors.water={kind: ds18b20, rename: {water: tank}}"],
            "sensors.water.rename.water: is not one of its readings; it has: water_temperature",
        ),
        (
            ["sensors.the-tank.kind=ds18b20"],
            "sensors.the-tank: is not a valid name: a to z, 0 to 9 and _ are needed",
        ),
        (
            ["sensors.water.kind=ds18b21"],
            "sensors.water.kind: no sensor is named 'ds18b21', did you mean 'ds18b20'?; installed: "
            "ads1115, ds18b20, ina219, ina226, lsm6dsox, simulated; for another one, install its "
            "package",
        ),
        (
            ["sensors.water.device=28"],
            "sensors.water.kind: one of ads1115, ds18b20, ina219, ina226, lsm6dsox, simulated is "
            "needed",
        ),
        (
            ["sensors=3"],
            "sensors: 3 is not valid: a section (a mapping of keys to values) is needed",
        ),
        (
            ["sensors.water={kind: ds18b20, shunt: 1}"],
            "sensors.water.shunt: unknown key with kind ds18b20; kinds that have it: ina219, "
            "ina226",
        ),
        (
            ["sensors.flow={kind: ads1115, full_scale: 3}"],
            "sensors.flow.full_scale: 3 is not valid: one of 6.144, 4.096, 2.048, 1.024, 0.512, "
            "0.256 V is needed",
        ),
        (
            ["robot=pi", "sensors.a.kind=ads1115", "sensors.a.address=72"],
            "sensors.a.address: 0x48 on /dev/i2c-1 is already the address of force_sensor: each "
            "chip needs a different address",
        ),
        (
            ["robot=virtual-pi", WATER],
            "sensors.water.kind: 'ds18b20' is not valid: the virtual Pi has an ADS1115, pigpiod "
            "and an INA219 or INA226; 'ina219', 'ina226' or 'simulated' is needed",
        ),
    ],
)
def test_a_wrong_sensor_is_refused_in_one_line(overrides: list[str], complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, overrides)
    assert str(caught.value).endswith(complaint)


def test_every_wrong_sensor_of_a_file_is_found(tmp_path: Path) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text(
        "tick: 9\nsensors:\n  a: {kind: no, shunt: 3}\n  b: {kind: ina219, shunt: x}\n  c: 3\n"
    )
    assert len(find(file)) == 4


def test_readings_can_be_renamed_and_sensors_of_a_file_left_out() -> None:
    config = load(None, [WATER, "sensors.tank={kind: ds18b20, rename: {water_temperature: room}}"])
    assert list(config.readings) == ["power", "water_temperature", "room"]
    assert config.limits.readings == ("power", "water_temperature", "room")
    assert list(load(None, [WATER, "sensors.water=null"]).readings) == ["power"]
    assert load("config/virtual-pi.yaml", ["robot=pi"]).limits.readings == ("power",)


def test_the_configuration_of_a_fish_with_an_unknown_sensor_is_adopted_without_it() -> None:
    data = msgspec.to_builtins(load(None, [WATER]))
    data["sensors"]["sonar"] = {"kind": "sonar", "range": 3}
    assert list(adopt(data).sensors) == ["water"]


def test_sensors_of_a_robot_have_stand_ins_on_a_simulated_fish_which_says_so() -> None:
    rig = Rig(
        *(WATER, "sensors.power_meter.kind=ina219", "sensors.flow={kind: simulated, name: flow}")
    )
    tick = rig.run(5)[-1]
    assert tick.readings == {
        "power": pytest.approx(0.06),
        "water_temperature": 25.0,
        "flow": pytest.approx(20.0, abs=0.1),
    }
    assert rig.loop.robot.limitations() == (
        "sensors.water is simulated, as the fish is: its readings are constant",
    )


def test_a_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    config = load(None, ["robot=pi", "sensors.imu.kind=lsm6dsox"])
    monkeypatch.setitem(sys.modules, "adafruit_lsm6ds", None)
    with ExitStack() as stack, pytest.raises(MissingPackage) as caught:
        assemble(config, VirtualClock(), stack, threaded=False)
    assert str(caught.value) == (
        "the package adafruit-circuitpython-lsm6ds is missing; install fishd[pi]"
    )
