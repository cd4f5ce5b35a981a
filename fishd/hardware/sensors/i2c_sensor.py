"""Base class of the sensors on an I2C bus, which may be that of the force sensor."""

import os
from abc import abstractmethod
from typing import Annotated, Any, ClassVar, TypeVar

from msgspec import Meta

from fishd.core.schema import note
from fishd.hardware import i2c
from fishd.hardware.driver import Claim, SensorDriver, SensorSettings


class I2cSensorSettings(SensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Bus and address of a chip."""

    bus: Annotated[i2c.Bus, note("I2C bus: N of /dev/i2c-N.")] = 1
    address: Annotated[Annotated[int, Meta(ge=0x08, le=0x77)], note("I2C address.")]


N = TypeVar("N", bound=I2cSensorSettings)


class I2cSensor(SensorDriver[N]):
    """A chip on the I2C bus, which is opened for it, and whose errors are explained."""

    chip: ClassVar[str]
    """Name of the chip, for messages."""
    packages: ClassVar[tuple[str, ...]] = ("adafruit-blinka", "adafruit-extended-bus")
    _bus: Any = None

    @property
    def place(self) -> str:
        """Chip, address and bus, for messages."""
        return f"the {self.chip} at {self.settings.address:#04x} on /dev/i2c-{self.settings.bus}"

    def open(self) -> None:
        """Open the bus, find the chip and set it up; raise OSError if that fails."""
        bus = i2c.open_bus(self.settings.bus)
        try:
            self.set_up(bus)
        except BaseException as error:
            i2c.close_bus(bus)
            # Adafruit's libraries raise ValueError if nothing answers.
            number = getattr(error.__context__, "errno", None)
            if not isinstance(error, ValueError) or number is None:
                raise
            raise OSError(number, os.strerror(number)) from None
        self._bus = bus

    @abstractmethod
    def set_up(self, bus: Any) -> None:
        """Find the chip on a bus, an object as `busio.I2C` is one; raise OSError if that fails."""

    def close(self) -> None:
        """Close the bus; never raises, may be called twice. The chip is left as it is."""
        bus, self._bus = self._bus, None
        if bus is not None:
            i2c.close_bus(bus)

    def explain(self, error: Exception) -> str:
        """Return one line that says what went wrong and what to check."""
        settings = self.settings
        return i2c.explain(error, settings.bus, settings.address, self.chip, self.section)

    @classmethod
    def claims(cls, settings: N) -> tuple[Claim, ...]:
        """Return the claim of the bus, which other drivers of the same fishd may use too."""
        return (i2c.claim(settings.bus),)
