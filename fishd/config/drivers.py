"""The sections whose keys depend on a driver: `force_sensor`, `servo` and `power_meter`."""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from msgspec import Struct

from fishd.core import text
from fishd.core.errors import UnknownDriver
from fishd.core.foreign_code import contained
from fishd.core.plugins import Plugins
from fishd.core.schema import Problem, UnknownKey, convert, fields_of, nearest
from fishd.hardware.driver import Claim, Driver
from fishd.hardware.registry import FORCE_SENSORS, POWER_METERS, SERVOS
from fishd.hardware.settings import ForceSensorSettings, PowerMeterSettings, ServoSettings

DRIVERS: dict[str, tuple[Plugins[Any], str | None]] = {
    "force_sensor": (FORCE_SENSORS, "ads1115"),
    "servo": (SERVOS, "pigpio"),
    "power_meter": (POWER_METERS, None),
}
"""Of each section: where its drivers are found, and which one is the default; None: none is."""
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


def convert_sections(data: Mapping[str, Any]) -> dict[str, Any]:
    """These sections of a configuration, each as the settings of its driver; raises `Problem`."""
    return {name: _convert(name, data.get(name)) for name in DRIVERS}


def driver_of(section: str, name: str) -> type[Driver[Any]]:
    """The driver of that name; raises `Problem` that lists those there are."""
    plugins, _ = DRIVERS[section]
    if name not in plugins.names():
        close = nearest(name, plugins.names())
        meant = f", {close}" if close.startswith("did") else ""
        raise Problem(
            (section, "driver"),
            f"no {plugins.kind} is named '{text.quoted(name)}'{meant}; installed: "
            f"{', '.join(plugins.names())}; for another one, install its package beside fishd",
        )
    try:
        found: type[Driver[Any]] = plugins.find(name)
    except UnknownDriver as error:
        raise Problem((section, "driver"), str(error)) from None
    return found


def settings_of_drivers(section: str) -> dict[str, type[Struct]]:
    """The settings of each driver that loads, by its name."""
    plugins, _ = DRIVERS[section]
    found: dict[str, type[Struct]] = {}
    for name in plugins.names():
        with suppress(UnknownDriver):
            found[name] = plugins.find(name).Settings
    return found


def keys() -> list[str]:
    """The keys of all drivers that load, in dotted form."""
    return [
        f"{section}.{field.name}"
        for section in DRIVERS
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
        driver = driver_of(section, settings.driver)
        if robot == "virtual-pi" and not driver.on_virtual_pi:
            raise Problem(
                (section, "driver"),
                f"'{settings.driver}' is not valid: the virtual Pi has an ADS1115, pigpiod and an "
                f"INA219 or INA226; '{VIRTUAL_PI[section]}' is needed",
            )
        try:
            contained(driver.check, settings, tick)
        except Problem as problem:
            raise Problem((section, *problem.path), str(problem)) from None
        except Exception as error:
            what = f"driver '{settings.driver}' cannot check its settings: {text.named(error)}"
            raise Problem((section,), what) from error


def claims_of(chosen: Chosen) -> dict[str, tuple[Claim, ...]]:
    """What the drivers use alone, by their sections."""
    return {
        section: driver_of(section, settings.driver).claims(settings)
        for section, settings in chosen.sections().items()
    }


def _convert(section: str, data: Any) -> Any:
    plugins, default = DRIVERS[section]
    if data is None:
        if default is None:
            return None
        data = {}
    if not isinstance(data, Mapping):
        raise Problem((section,), "a section (a mapping of keys to values) is needed")
    name = data.get("driver", default) or None
    if not isinstance(name, str):
        raise Problem((section, "driver"), f"one of {', '.join(plugins.names())} is needed")
    target = driver_of(section, name).Settings
    try:
        return convert({**data, "driver": name}, target, prefix=(section,))
    except UnknownKey as problem:
        key = problem.path[-1]
        having = [
            other
            for other, struct in settings_of_drivers(section).items()
            if any(field.name == key for field in fields_of(struct))
        ]
        if not having:
            raise
        others = ", ".join(having)
        message = f"unknown key with driver {name}; drivers that have it: {others}"
        raise UnknownKey(problem.path, message) from None
