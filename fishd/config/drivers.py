"""The sections whose keys depend on a name: `force_sensor`, `servo`, `power_meter` and `plant`.

The name is that of a driver, or of the plant that swims; packages beside fishd may offer others.
"""

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from msgspec import Struct

from fishd.core import text
from fishd.core.errors import UnknownDriver, UnknownPlant
from fishd.core.foreign_code import contained
from fishd.core.plugins import Plugins
from fishd.core.schema import Problem, UnknownKey, convert, fields_of, nearest, shown
from fishd.hardware.driver import Claim, Driver
from fishd.hardware.force_sensor.ads1115 import Ads1115Settings
from fishd.hardware.registry import FORCE_SENSORS, POWER_METERS, SERVOS
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.settings import ForceSensorSettings, PowerMeterSettings, ServoSettings
from fishd.virtual.plant.parameters import TETHERED, PlantParameters
from fishd.virtual.plant.registry import PLANTS


class Choice(NamedTuple):
    """What a section may be about."""

    plugins: Plugins[Any]
    """Where it is found by name."""
    default: str | None
    """None: the section may be left out."""
    settings: type[Struct]
    """The keys with the default; without one, those that all have."""
    key: str
    """The key that names it."""
    page: str
    """Page in docs/how-to/ about how to write another one."""


CHOICES = {
    "force_sensor": Choice(
        FORCE_SENSORS, "ads1115", Ads1115Settings, "driver", "writing-a-driver.md"
    ),
    "servo": Choice(SERVOS, "pigpio", PigpioSettings, "driver", "writing-a-driver.md"),
    "power_meter": Choice(POWER_METERS, None, PowerMeterSettings, "driver", "writing-a-driver.md"),
    "plant": Choice(PLANTS, TETHERED, PlantParameters, "model", "writing-a-plant.md"),
}
"""By section."""
VIRTUAL_PI = {"force_sensor": "ads1115", "servo": "pigpio", "power_meter": "ina219' or 'ina226"}
"""What a virtual Pi has, by their drivers."""


class Chosen(NamedTuple):
    """The settings of each section, of its driver."""

    force_sensor: ForceSensorSettings
    servo: ServoSettings
    power_meter: PowerMeterSettings | None

    def sections(self) -> dict[str, Any]:
        """Those that there are, by name."""
        return {name: found for name, found in self._asdict().items() if found is not None}


def convert_sections(
    data: Mapping[str, Any], elsewhere: Callable[[], list[str]] = list
) -> dict[str, Any]:
    """These sections of a configuration, each with the keys that it then has; raises `Problem`.

    elsewhere: gives keys of other sections to suggest, in dotted form
    """
    return {name: _convert(name, data.get(name), elsewhere) for name in CHOICES}


def driver_of(section: str, name: str) -> type[Any]:
    """The driver or plant of that name; raises `Problem` that lists those there are."""
    plugins, key = CHOICES[section].plugins, CHOICES[section].key
    if not plugins.has(name):
        close = nearest(name, plugins.names())
        meant = f", {close}" if close.startswith("did") else ""
        raise Problem(
            (section, key),
            f"no {plugins.kind} is named '{text.quoted(name)}'{meant}; installed: "
            f"{', '.join(plugins.names())}; for another one, install its package beside fishd",
        )
    try:
        found: type[Any] = plugins.find(name)
    except (UnknownDriver, UnknownPlant) as error:
        raise Problem((section, key), str(error)) from None
    return found


def settings_of_drivers(section: str) -> dict[str, type[Struct]]:
    """The settings of each driver or plant that loads, by its name."""
    found: dict[str, type[Struct]] = {}
    for name in CHOICES[section].plugins.names():
        with suppress(Problem):
            found[name] = _settings(section, name)
    return found


def keys() -> list[str]:
    """The keys of all drivers and plants that load, in dotted form."""
    return [
        f"{section}.{field.name}"
        for section in CHOICES
        for struct in settings_of_drivers(section).values()
        for field in fields_of(struct)
    ]


def check_drivers(robot: str, tick: float, chosen: Chosen) -> None:
    """What each driver itself demands of its settings, and that the robot has its hardware.

    tick: period of the loop [s]
    """
    if robot in ("simulated", "swimmer"):  # whose loop may be faster than any hardware
        tick = math.inf
    for section, settings in chosen.sections().items():
        driver: type[Driver[Any]] = driver_of(section, settings.driver)
        if robot == "virtual-pi" and not driver.on_virtual_pi:
            raise Problem(
                (section, "driver"),
                f"'{settings.driver}' is not valid: the virtual Pi has an ADS1115, pigpiod and an "
                f"INA219 or INA226; '{VIRTUAL_PI[section]}' is needed",
            )
        _check(section, settings.driver, partial(driver.check, settings, tick))


def check_plant(plant: PlantParameters) -> None:
    """What a plant of another package itself demands of its parameters."""
    if plant.model == TETHERED:
        return
    _check("plant", plant.model, partial(driver_of("plant", plant.model).check, plant))
    try:
        hash(plant)
    except TypeError:
        what = f"plant '{plant.model}' has keys that no two fish can be compared by: numbers, "
        raise Problem(("plant",), what + "texts and tuples are needed") from None


def _check(section: str, name: str, demands: Callable[[], None]) -> None:
    try:
        contained(demands)
    except Problem as problem:
        raise Problem((section, *problem.path), str(problem)) from None
    except Exception as error:
        kind = CHOICES[section].key if section != "plant" else section
        what = f"{kind} '{name}' cannot check its settings: {text.named(error)}"
        raise Problem((section,), what) from error


def claims_of(chosen: Chosen) -> dict[str, tuple[Claim, ...]]:
    """What the drivers use alone, by their sections."""
    return {
        section: driver_of(section, settings.driver).claims(settings)
        for section, settings in chosen.sections().items()
    }


def _settings(section: str, name: str) -> type[Struct]:
    """The keys of a section with this driver or plant; raises `Problem`."""
    choice = CHOICES[section]
    if name == choice.default:  # which is not loaded for that: plants bring numpy
        return choice.settings
    settings: type[Struct] = driver_of(section, name).Settings
    return settings


def _convert(section: str, data: Any, elsewhere: Callable[[], list[str]]) -> Any:
    plugins, default, _, key, _ = CHOICES[section]
    if data is None:
        if default is None:
            return None
        data = {}
    if not isinstance(data, Mapping):
        what = f"{shown(data)} is not valid: a section (a mapping of keys to values) is needed"
        raise Problem((section,), what)
    name = data.get(key, default) or None
    if not isinstance(name, str):
        raise Problem((section, key), f"one of {', '.join(plugins.names())} is needed")
    target = _settings(section, name)
    try:
        return convert({**data, key: name}, target, prefix=(section,), elsewhere=elsewhere)
    except UnknownKey as problem:
        unknown = problem.path[-1]
        having = [
            other
            for other, struct in settings_of_drivers(section).items()
            if any(field.name == unknown for field in fields_of(struct))
        ]
        if not having:
            raise
        others = ", ".join(having)
        message = f"unknown key with {key} {name}; {key}s that have it: {others}"
        raise UnknownKey(problem.path, message) from None
