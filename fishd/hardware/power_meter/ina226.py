"""INA226, register by register: no maintained library supports the bus that fishd uses."""

import errno
from typing import Any

from fishd.hardware.power_meter.ina import Ina, InaSettings, Shunt

SHUNT_STEP_V = 2.5e-6
"""Step of the voltage over the shunt [V]."""
SUPPLY_STEP_V = 1.25e-3
"""Step of the supply voltage [V]."""
CONVERSION_TIMES_S = (140e-6, 204e-6, 332e-6, 588e-6, 1.1e-3, 2.116e-3, 4.156e-3, 8.244e-3)
"""Time of a conversion for each value of its bits in the config [s]."""
AVERAGE_COUNTS = (1, 4, 16, 64, 128, 256, 512, 1024)
"""Number of conversions in an average for each value of its bits in the config."""

CONFIG, SHUNT, SUPPLY, MANUFACTURER = 0x00, 0x01, 0x02, 0xFE
TEXAS_INSTRUMENTS_ID = 0x5449
_CONTINUOUS_MODE = 0x4007
"""Bits of the config: both voltages, one after the other, continuously."""
_SETTINGS_MASK = 0x0FFF
"""Mask of the config: the bits above have no meaning."""


class Ina226Settings(InaSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The INA226 in the servo's supply; see its board for the value of the shunt."""

    shunt: Shunt = 0.01


class Ina226(Ina[Ina226Settings]):
    """An INA226 on the I2C bus; up to 8.2 A with a shunt of 0.01 Ω."""

    Settings = Ina226Settings
    packages = ("adafruit-blinka", "adafruit-extended-bus")
    chip = "INA226"
    full_scale = 0.0819
    _i2c_bus: Any

    def set_up(self, bus: Any) -> None:
        """Set the chip to average the shunt's voltage without gaps, and the supply's briefly."""
        self._i2c_bus = bus
        bus.try_lock()
        if self._register(MANUFACTURER) != TEXAS_INSTRUMENTS_ID:
            raise OSError(errno.ENODEV, f"{self.place} identifies itself as another chip")
        average, bits = min(
            (AVERAGE_COUNTS.index(count), bits)
            for count in AVERAGE_COUNTS
            for bits, duration in enumerate(CONVERSION_TIMES_S)
            if count * (duration + CONVERSION_TIMES_S[0]) >= self.min_measuring_time
        )
        self._config = _CONTINUOUS_MODE | average << 9 | bits << 3
        bus.writeto(self.settings.address, bytes([CONFIG]) + self._config.to_bytes(2, "big"))

    def is_set_up(self) -> bool:
        """Do as `Ina.is_set_up`."""
        return (self._register(CONFIG) ^ self._config) & _SETTINGS_MASK == 0

    def volts(self) -> tuple[float, float]:
        """Do as `Ina.volts`."""
        shunt = (self._register(SHUNT) ^ 0x8000) - 0x8000
        return self._register(SUPPLY) * SUPPLY_STEP_V, shunt * SHUNT_STEP_V

    def _register(self, number: int) -> int:
        word = bytearray(2)
        self._i2c_bus.writeto_then_readfrom(self.settings.address, bytes([number]), word)
        return int.from_bytes(word, "big")
