"""INA219 through its Adafruit driver."""

import os
from typing import Any

from fishd.core.clock import Clock
from fishd.hardware.power_meter.ina import Ina, InaSettings

SHUNT_STEP_V = 10e-6
"""Step of the voltage over the shunt [V]."""
SUPPLY_STEP_V = 4e-3
"""Step of the supply voltage [V]."""
CONVERSION_TIME_S = 532e-6
"""Time of a conversion at 12 bits [s]; the shunt's voltage is averaged over several."""


class Ina219Settings(InaSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The INA219 in the servo's supply; common boards have a shunt of 0.1 Ω."""


class Ina219(Ina[Ina219Settings]):
    """An INA219 on the I2C bus; up to 3.2 A with a shunt of 0.1 Ω."""

    Settings = Ina219Settings
    packages = ("adafruit-blinka", "adafruit-circuitpython-ina219", "adafruit-extended-bus")
    chip = "INA219"
    full_scale = 0.32
    _chip: Any

    def __init__(self, settings: Ina219Settings, clock: Clock, interval: float) -> None:
        """Import the library; raise ImportError if it is not installed."""
        from adafruit_ina219 import INA219

        super().__init__(settings, clock, interval)
        self._library = INA219

    def set_up(self, bus: Any) -> None:
        """Set up the chip as the library does, but average the shunt's voltage without gaps."""
        try:
            self._chip = self._library(bus, self.settings.address)
        except ValueError as error:  # raised by the library if nothing answers
            number = getattr(error.__context__, "errno", None)
            if number is None:
                raise
            raise OSError(number, os.strerror(number)) from None
        doublings = 1
        while doublings < 7 and (2**doublings + 1) * CONVERSION_TIME_S < self.min_measuring_time:
            doublings += 1
        self._resolution = 0x8 | doublings  # 2, 4 … 128 samples
        self._chip.shunt_adc_resolution = self._resolution

    def is_set_up(self) -> bool:
        """Do as `Ina.is_set_up`; the other settings are those after a reset."""
        return bool(self._chip.shunt_adc_resolution == self._resolution)

    def volts(self) -> tuple[float, float]:
        """Do as `Ina.volts`."""
        chip = self._chip
        return chip.raw_bus_voltage * SUPPLY_STEP_V, chip.raw_shunt_voltage * SHUNT_STEP_V
