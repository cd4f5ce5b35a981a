"""Sections whose keys depend on a name: `force_sensor`, `servo`, `plant` and each of `sensors`.

The name is that of a driver, or of the plant; other packages may add drivers and plants.
"""

import math
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from msgspec import Struct

from fishd.core import text
from fishd.core.errors import UnknownDriver, UnknownPlant
from fishd.core.foreign_code import call_foreign
from fishd.core.plugins import Plugins
from fishd.core.robots import find_kind
from fishd.core.schema import (
    Problem,
    Reading,
    UnknownKey,
    convert,
    fields_of,
    format_excerpt,
    suggest,
)
from fishd.core.signals import Tick
from fishd.hardware.driver import Claim, Driver
from fishd.hardware.force_sensor.ads1115 import Ads1115Settings
from fishd.hardware.registry import FORCE_SENSORS, SENSORS, SERVOS
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.settings import ForceSensorSettings, SensorSettings, ServoSettings
from fishd.virtual.plant.parameters import TETHERED, PlantParameters
from fishd.virtual.plant.registry import PLANTS

SENSOR_SECTIONS = "sensors"
"""Section whose keys are the names of sensors; each contains a section."""
_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
"""Permitted names of sensors and of readings."""


class Choice(NamedTuple):
    """Section whose keys depend on a name."""

    plugins: Plugins[Any]
    """Registry of the drivers or plants."""
    default: str | None
    """Default name; None for the sections of `sensors`, of which any number may be there."""
    settings: type[Struct]
    """Struct of the keys with the default name; without a default, of the common keys."""
    key: str
    """Key that contains the name."""
    page: str
    """Page in docs/how-to/ on how to write a driver or plant."""


CHOICES = {
    "force_sensor": Choice(
        FORCE_SENSORS, "ads1115", Ads1115Settings, "driver", "writing-a-driver.md"
    ),
    "servo": Choice(SERVOS, "pigpio", PigpioSettings, "driver", "writing-a-driver.md"),
    SENSOR_SECTIONS: Choice(SENSORS, None, SensorSettings, "kind", "writing-a-driver.md"),
    "plant": Choice(PLANTS, TETHERED, PlantParameters, "model", "writing-a-plant.md"),
}
"""Choices by section."""
VIRTUAL_PI = {
    "force_sensor": "ads1115",
    "servo": "pigpio",
    SENSOR_SECTIONS: "ina219', 'ina226' or 'simulated",
}
"""Drivers of the hardware of a virtual Pi, by section."""


class DriverSettings(NamedTuple):
    """Settings of the driver in each section."""

    force_sensor: ForceSensorSettings
    servo: ServoSettings
    sensors: Mapping[str, SensorSettings]

    def sections(self) -> dict[str, Any]:
        """Return all sections by name, that of a sensor such as `sensors.water`."""
        sensors = {f"{SENSOR_SECTIONS}.{name}": each for name, each in self.sensors.items()}
        return {"force_sensor": self.force_sensor, "servo": self.servo, **sensors}


def choice_of(section: str) -> Choice:
    """Return the choice of a section, such as `servo` or `sensors.water`."""
    return CHOICES[section.partition(".")[0]]


def name_of(section: str, settings: Struct) -> str:
    """Return the name of the driver or plant that the settings of a section choose."""
    name: str = getattr(settings, choice_of(section).key)
    return name


def convert_driver_sections(
    data: Mapping[str, Any], elsewhere: Callable[[], list[str]] = list
) -> dict[str, Any]:
    """Return these sections of a configuration, converted and validated; raise `Problem`.

    elsewhere: function that returns keys of other sections as suggestions, in dotted form
    """
    names = [name for name in CHOICES if name != SENSOR_SECTIONS]
    sections = {name: _convert(name, data.get(name), elsewhere) for name in names}
    return sections | {SENSOR_SECTIONS: _convert_sensors(data.get(SENSOR_SECTIONS), elsewhere)}


def _convert_sensors(data: Any, elsewhere: Callable[[], list[str]]) -> dict[str, SensorSettings]:
    """Return the sensors by name; null leaves one out, such as one of a file."""
    data = _check_mapping(SENSOR_SECTIONS, data)
    for name in data:
        if not _NAME.fullmatch(name):
            raise Problem(
                (SENSOR_SECTIONS, name), "is not a valid name: a to z, 0 to 9 and _ are needed"
            )
    return {
        name: _convert(f"{SENSOR_SECTIONS}.{name}", section, elsewhere)
        for name, section in data.items()
        if section is not None
    }


def find_driver(section: str, name: str) -> type[Any]:
    """Return the driver or plant of that name; raise `Problem`, which lists those installed."""
    plugins, key = choice_of(section).plugins, choice_of(section).key
    if not plugins.has(name):
        hint = suggest(name, plugins.names())
        suggestion = f", {hint}" if hint.startswith("did") else ""
        raise Problem(
            (*section.split("."), key),
            f"no {plugins.kind} is named '{text.quoted(name)}'{suggestion}; installed: "
            f"{', '.join(plugins.names())}; for another one, install its package",
        )
    try:
        plugin: type[Any] = plugins.find(name)
    except (UnknownDriver, UnknownPlant) as error:
        raise Problem((*section.split("."), key), str(error)) from None
    return plugin


def settings_of_drivers(section: str) -> dict[str, type[Struct]]:
    """Return the settings class of each driver or plant that loads, by name."""
    structs: dict[str, type[Struct]] = {}
    for name in CHOICES[section].plugins.names():
        with suppress(Problem):
            structs[name] = _settings(section, name)
    return structs


def driver_keys() -> list[str]:
    """Return the keys of all drivers and plants that load: `servo.gpio`, `sensors.NAME.kind`."""
    return [
        f"{section}{'.NAME' * (section == SENSOR_SECTIONS)}.{field.name}"
        for section in CHOICES
        for struct in settings_of_drivers(section).values()
        for field in fields_of(struct)
    ]


def check_drivers(robot: str, tick: float, driver_settings: DriverSettings) -> None:
    """Check the settings of each driver with the driver, and that the robot has its hardware.

    tick: period of the loop [s]
    """
    kind = find_kind(robot)
    if not kind.has_hardware:  # their loop may be faster than the hardware permits
        tick = math.inf
    for section, settings in driver_settings.sections().items():
        name = name_of(section, settings)
        driver: type[Driver[Any]] = find_driver(section, name)
        if kind.is_virtual and not driver.on_virtual_pi:
            raise Problem(
                (*section.split("."), choice_of(section).key),
                f"'{name}' is not valid: the virtual Pi has an ADS1115, pigpiod and an INA219 or "
                f"INA226; '{VIRTUAL_PI[section.partition('.')[0]]}' is needed",
            )
        _check(section, name, partial(driver.check, settings, tick))


def readings_of(settings: SensorSettings) -> dict[str, Reading]:
    """Return the readings of a sensor, with the names that the configuration gives them."""
    kind = find_driver(SENSOR_SECTIONS, settings.kind)
    declared = call_foreign(kind.declare, settings)
    return {settings.rename.get(name, name): reading for name, reading in declared.items()}


def check_readings(sensors: Mapping[str, SensorSettings]) -> None:
    """Check that each reading has a valid name of its own."""
    owners = dict.fromkeys((*Tick.__struct_fields__, "elapsed"), "a column of every tick")
    for sensor, settings in sensors.items():
        path = (SENSOR_SECTIONS, sensor)
        try:
            readings = readings_of(settings)
        except Problem:
            raise
        except Exception as error:
            why = text.describe_error(error)
            raise Problem(path, f"kind '{settings.kind}' cannot declare readings: {why}") from error
        remedy = f"another name is needed, as in {'.'.join(path)}.rename"
        for name, reading in readings.items():
            if not isinstance(reading, Reading) or not _NAME.fullmatch(name):
                raise Problem(
                    path,
                    f"its reading '{text.quoted(name)}' is not valid: a name of a to z, 0 to 9 and "
                    "_, with a Reading, is needed",
                )
            if name in owners:
                raise Problem(
                    path, f"its reading {name} is the name of {owners[name]} already: {remedy}"
                )
            owners[name] = f"a reading of {'.'.join(path)}"
        for old, new in settings.rename.items():
            if new not in readings:
                known = suggest(old, list(readings), listed="it has")
                raise Problem((*path, "rename", old), f"is not one of its readings; {known}")


def check_plant(plant: PlantParameters) -> None:
    """Check the parameters of a plant of another package with that plant."""
    if plant.model == TETHERED:
        return
    _check("plant", plant.model, partial(find_driver("plant", plant.model).check, plant))
    try:
        hash(plant)
    except TypeError:
        what = f"plant '{plant.model}' has keys that cannot be compared between fish: numbers, "
        raise Problem(("plant",), what + "texts and tuples are needed") from None


def _check(section: str, name: str, check: Callable[[], None]) -> None:
    try:
        call_foreign(check)
    except Problem as problem:
        raise Problem((*section.split("."), *problem.path), str(problem)) from None
    except Exception as error:
        kind = choice_of(section).key if section != "plant" else section
        what = f"{kind} '{name}' cannot check its settings: {text.describe_error(error)}"
        raise Problem(tuple(section.split(".")), what) from error


def claims_of(driver_settings: DriverSettings) -> dict[str, tuple[Claim, ...]]:
    """Return the claims of the drivers, by section."""
    return {
        section: find_driver(section, name_of(section, settings)).claims(settings)
        for section, settings in driver_settings.sections().items()
    }


def _settings(section: str, name: str) -> type[Struct]:
    """Return the settings class of a driver or plant; raise `Problem`."""
    choice = choice_of(section)
    if name == choice.default:  # do not load the default for this: plants import numpy
        return choice.settings
    settings: type[Struct] = find_driver(section, name).Settings
    return settings


def _check_mapping(section: str, data: Any) -> Mapping[str, Any]:
    """Return the data of a section, none for null; raise `Problem` for anything else."""
    if data is None:
        return {}
    if isinstance(data, Mapping):
        return data
    what = f"{format_excerpt(data)} is not valid: a section (a mapping of keys to values) is needed"
    raise Problem(tuple(section.split(".")), what)


def _convert(section: str, data: Any, elsewhere: Callable[[], list[str]]) -> Any:
    plugins, default, _, key, _ = choice_of(section)
    path = tuple(section.split("."))
    data = _check_mapping(section, data)
    name = data.get(key, default) or None
    if not isinstance(name, str):
        raise Problem((*path, key), f"one of {', '.join(plugins.names())} is needed")
    target = _settings(section, name)
    try:
        return convert({**data, key: name}, target, prefix=path, elsewhere=elsewhere)
    except UnknownKey as problem:
        unknown = problem.path[-1]
        names = [
            driver
            for driver, struct in settings_of_drivers(path[0]).items()
            if any(field.name == unknown for field in fields_of(struct))
        ]
        if not names:
            raise
        others = ", ".join(names)
        message = f"unknown key with {key} {name}; {key}s that have it: {others}"
        raise UnknownKey(problem.path, message) from None
