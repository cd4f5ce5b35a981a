"""Finds drivers by name, fishd's own and those of other packages."""

from typing import Any

from fishd.core.errors import UnknownDriver
from fishd.core.plugins import Plugins
from fishd.hardware.driver import ForceSensorDriver, ServoDriver

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
