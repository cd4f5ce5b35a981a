"""Registries of drivers, fishd's and those of other packages, and errors of missing libraries."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fishd.core import text
from fishd.core.errors import FishdError, MissingPackage, StartupError, UnknownDriver
from fishd.core.plugins import Plugins
from fishd.hardware.driver import ForceSensorDriver, SensorDriver, ServoDriver

FORCE_SENSORS: Plugins[ForceSensorDriver[Any]] = Plugins(
    "force-sensor driver",
    "fishd.force_sensors",
    ForceSensorDriver,
    "Settings",
    {"ads1115": "fishd.hardware.force_sensor.ads1115:Ads1115"},
    UnknownDriver,
)
SERVOS: Plugins[ServoDriver[Any]] = Plugins(
    "servo driver",
    "fishd.servos",
    ServoDriver,
    "Settings",
    {
        "pigpio": "fishd.hardware.servo.pigpio:Pigpio",
        "sysfs-pwm": "fishd.hardware.servo.sysfs_pwm:SysfsPwm",
        "rpi-gpio": "fishd.hardware.servo.rpi_gpio:RpiGpio",
    },
    UnknownDriver,
)
SENSORS: Plugins[SensorDriver[Any]] = Plugins(
    "sensor",
    "fishd.sensors",
    SensorDriver,
    "Settings",
    {
        "ads1115": "fishd.hardware.sensors.analog:AnalogInput",
        "ds18b20": "fishd.hardware.sensors.ds18b20:Ds18b20",
        "ina219": "fishd.hardware.sensors.ina:Ina219",
        "ina226": "fishd.hardware.sensors.ina:Ina226",
        "lsm6dsox": "fishd.hardware.sensors.lsm6dsox:Lsm6dsox",
        "simulated": "fishd.hardware.sensors.simulated:Simulated",
    },
    UnknownDriver,
)

PACKAGES = {
    "adafruit_ads1x15": "adafruit-circuitpython-ads1x15",
    "adafruit_bus_device": "adafruit-circuitpython-busdevice",
    "adafruit_ina219": "adafruit-circuitpython-ina219",
    "adafruit_lsm6ds": "adafruit-circuitpython-lsm6ds",
    "adafruit_extended_bus": "adafruit-extended-bus",
    "Adafruit_PureIO": "Adafruit-PureIO",
    "board": "Adafruit-Blinka",
    "busio": "Adafruit-Blinka",
    "gpiod": "gpiod",
    "pigpio": "pigpio",
}
"""Package of each module that a driver of fishd imports."""


@contextmanager
def driver_packages(driver: str = "") -> Iterator[None]:
    """Translate the errors of importing and opening a driver.

    Raises `MissingPackage` if a library is not installed. If the driver is named, raises
    `StartupError` for every other exception that is not a `FishdError`.
    """
    try:
        yield
    except FishdError:
        raise
    except ImportError as error:
        raise MissingPackage(why_not_imported(error, driver)) from None
    except Exception as error:
        if not driver:
            raise
        raise StartupError(
            f"driver '{driver}' cannot start: {text.describe_error(error)}"
        ) from error


def why_not_imported(error: ImportError, driver: str = "") -> str:
    """Return one line that names the package that caused a failed import."""
    module = (error.name or "").partition(".")[0]
    package = PACKAGES.get(module, module)
    if driver and package not in PACKAGES.values():
        return f"driver '{driver}' needs the package {package or 'that it imports'}: {error}"
    if isinstance(error, ModuleNotFoundError) and package:
        return f"the package {package} is missing; install fishd[pi]"
    return f"the package {package or 'of a driver'} cannot be imported ({error}); install fishd[pi]"
