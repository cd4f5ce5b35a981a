"""The inertial sensor LSM6DSOX: acceleration and rotation of what it is mounted on."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from fishd.core.clock import Clock
from fishd.core.schema import Reading, note
from fishd.hardware.sensors.i2c_sensor import I2cSensor, I2cSensorSettings

MAX_ACCELERATION, MAX_ROTATION = 39.2, 4.36
"""Ends of the ranges that the library sets: 4 g [m/s²] and 250 degrees per second [rad/s]."""


class Lsm6dsoxSettings(I2cSensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Address of the chip."""

    address: Annotated[Literal[106, 107], note("I2C address, set by the pin SDO; 106 is 0x6a.")] = (
        106
    )


class Lsm6dsox(I2cSensor[Lsm6dsoxSettings]):
    """An LSM6DSOX on the I2C bus, in the axes that are printed on its board."""

    Settings = Lsm6dsoxSettings
    packages = (*I2cSensor.packages, "adafruit-circuitpython-lsm6ds")
    chip = "LSM6DSOX"
    readings: ClassVar[Mapping[str, Reading]] = {
        **{
            f"acceleration_{axis}": Reading(
                "m/s²", f"Acceleration along {axis}.", -MAX_ACCELERATION, MAX_ACCELERATION
            )
            for axis in "xyz"
        },
        **{
            f"rotation_{axis}": Reading(
                "rad/s", f"Angular velocity about {axis}.", -MAX_ROTATION, MAX_ROTATION
            )
            for axis in "xyz"
        },
    }
    _chip: Any

    def __init__(
        self, settings: Lsm6dsoxSettings, clock: Clock, period: float, section: str
    ) -> None:
        """Import the library; raise ImportError if it is not installed."""
        from adafruit_lsm6ds import lsm6dsox

        super().__init__(settings, clock, period, section)
        self._library = lsm6dsox

    def set_up(self, bus: Any) -> None:
        """Reset the chip and set it to 104 measurements per second; raise OSError."""
        self._chip = self._library.LSM6DSOX(bus, self.settings.address)

    def sample(self) -> dict[str, float]:
        """Read both; raise OSError if that fails, and after a reset of the chip."""
        if not self._chip.accelerometer_data_rate:
            raise OSError(f"{self.place} lost its settings: its supply was interrupted")
        values = (*self._chip.acceleration, *self._chip.gyro)
        return dict(zip(self.readings, values, strict=True))
