"""Sections whose keys depend on a name: `force_sensor`, `servo`, `power_meter` and `plant`.

The name is that of a driver, or of the plant; other packages may add drivers and plants.
"""

import math
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
from fishd.core.schema import Problem, UnknownKey, convert, fields_of, format_excerpt, suggest
from fishd.hardware.driver import Claim, Driver
from fishd.hardware.force_sensor.ads1115 import Ads1115Settings
from fishd.hardware.registry import FORCE_SENSORS, POWER_METERS, SERVOS
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.settings import ForceSensorSettings, PowerMeterSettings, ServoSettings
from fishd.virtual.plant.parameters import TETHERED, PlantParameters
from fishd.virtual.plant.registry import PLANTS


class Choice(NamedTuple):
    """Section whose keys depend on a name."""

    plugins: Plugins[Any]
    """Registry of the drivers or plants."""
    default: str | None
    """Default name; None if the section may be left out."""
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
    "power_meter": Choice(POWER_METERS, None, PowerMeterSettings, "driver", "writing-a-driver.md"),
    "plant": Choice(PLANTS, TETHERED, PlantParameters, "model", "writing-a-plant.md"),
}
"""Choices by section."""
VIRTUAL_PI = {"force_sensor": "ads1115", "servo": "pigpio", "power_meter": "ina219' or 'ina226"}
"""Drivers of the hardware of a virtual Pi, by section."""


class DriverSettings(NamedTuple):
    """Settings of the driver in each section."""

    force_sensor: ForceSensorSettings
    servo: ServoSettings
    power_meter: PowerMeterSettings | None

    def sections(self) -> dict[str, Any]:
        """Return the sections that are not None, by name."""
        return {name: section for name, section in self._asdict().items() if section is not None}


def convert_driver_sections(
    data: Mapping[str, Any], elsewhere: Callable[[], list[str]] = list
) -> dict[str, Any]:
    """Return these sections of a configuration, converted and validated; raise `Problem`.

    elsewhere: function that returns keys of other sections as suggestions, in dotted form
    """
    return {name: _convert(name, data.get(name), elsewhere) for name in CHOICES}


def find_driver(section: str, name: str) -> type[Any]:
    """Return the driver or plant of that name; raise `Problem`, which lists those installed."""
    plugins, key = CHOICES[section].plugins, CHOICES[section].key
    if not plugins.has(name):
        hint = suggest(name, plugins.names())
        suggestion = f", {hint}" if hint.startswith("did") else ""
        raise Problem(
            (section, key),
            f"no {plugins.kind} is named '{text.quoted(name)}'{suggestion}; installed: "
            f"{', '.join(plugins.names())}; for another one, install its package",
        )
    try:
        plugin: type[Any] = plugins.find(name)
    except (UnknownDriver, UnknownPlant) as error:
        raise Problem((section, key), str(error)) from None
    return plugin


def settings_of_drivers(section: str) -> dict[str, type[Struct]]:
    """Return the settings class of each driver or plant that loads, by name."""
    structs: dict[str, type[Struct]] = {}
    for name in CHOICES[section].plugins.names():
        with suppress(Problem):
            structs[name] = _settings(section, name)
    return structs


def driver_keys() -> list[str]:
    """Return the keys of all drivers and plants that load, in dotted form."""
    return [
        f"{section}.{field.name}"
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
        driver: type[Driver[Any]] = find_driver(section, settings.driver)
        if kind.is_virtual and not driver.on_virtual_pi:
            raise Problem(
                (section, "driver"),
                f"'{settings.driver}' is not valid: the virtual Pi has an ADS1115, pigpiod and an "
                f"INA219 or INA226; '{VIRTUAL_PI[section]}' is needed",
            )
        _check(section, settings.driver, partial(driver.check, settings, tick))


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
        raise Problem((section, *problem.path), str(problem)) from None
    except Exception as error:
        kind = CHOICES[section].key if section != "plant" else section
        what = f"{kind} '{name}' cannot check its settings: {text.describe_error(error)}"
        raise Problem((section,), what) from error


def claims_of(driver_settings: DriverSettings) -> dict[str, tuple[Claim, ...]]:
    """Return the claims of the drivers, by section."""
    return {
        section: find_driver(section, settings.driver).claims(settings)
        for section, settings in driver_settings.sections().items()
    }


def _settings(section: str, name: str) -> type[Struct]:
    """Return the settings class of a driver or plant; raise `Problem`."""
    choice = CHOICES[section]
    if name == choice.default:  # do not load the default for this: plants import numpy
        return choice.settings
    settings: type[Struct] = find_driver(section, name).Settings
    return settings


def _convert(section: str, data: Any, elsewhere: Callable[[], list[str]]) -> Any:
    plugins, default, _, key, _ = CHOICES[section]
    if data is None:
        if default is None:
            return None
        data = {}
    if not isinstance(data, Mapping):
        what = (
            f"{format_excerpt(data)} is not valid: a section (a mapping of keys to values) is "
            "needed"
        )
        raise Problem((section,), what)
    name = data.get(key, default) or None
    if not isinstance(name, str):
        raise Problem((section, key), f"one of {', '.join(plugins.names())} is needed")
    target = _settings(section, name)
    try:
        return convert({**data, key: name}, target, prefix=(section,), elsewhere=elsewhere)
    except UnknownKey as problem:
        unknown = problem.path[-1]
        names = [
            driver
            for driver, struct in settings_of_drivers(section).items()
            if any(field.name == unknown for field in fields_of(struct))
        ]
        if not names:
            raise
        others = ", ".join(names)
        message = f"unknown key with {key} {name}; {key}s that have it: {others}"
        raise UnknownKey(problem.path, message) from None
