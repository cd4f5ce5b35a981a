"""The INA226, register by register: no library of it is kept up that knows our bus."""

import errno
from typing import Any

from fishd.hardware.power_meter.ina import Ina, InaSettings, Shunt

SHUNT_STEP = 2.5e-6
"""[V]"""
SUPPLY_STEP = 1.25e-3
"""[V]"""
CONVERSIONS = (140e-6, 204e-6, 332e-6, 588e-6, 1.1e-3, 2.116e-3, 4.156e-3, 8.244e-3)
"""Of either voltage, by its bits [s]."""
AVERAGES = (1, 4, 16, 64, 128, 256, 512, 1024)
"""How many of them make one, by its bits."""

CONFIG, SHUNT, SUPPLY, MANUFACTURER = 0x00, 0x01, 0x02, 0xFE
TEXAS_INSTRUMENTS = 0x5449
_ALWAYS = 0x4007
"""Both voltages, one after the other, without an end."""
_WHAT_COUNTS = 0x0FFF
"""Of the settings: the bits above have no meaning."""


class Ina226Settings(InaSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The INA226 in the servo's supply; look at what shunt its board has."""

    shunt: Shunt = 0.01


class Ina226(Ina[Ina226Settings]):
    """An INA226 on the I2C bus; up to 8.2 A with a shunt of 0.01 Ω."""

    Settings = Ina226Settings
    packages = ("adafruit-blinka", "adafruit-extended-bus")
    chip = "INA226"
    full_scale = 0.0819
    _wires: Any

    def set_up(self, bus: Any) -> None:
        """The shunt for so long that no current goes unseen, the supply for a moment."""
        self._wires = bus
        bus.try_lock()
        if self._register(MANUFACTURER) != TEXAS_INSTRUMENTS:
            raise OSError(errno.ENODEV, f"{self.place} says that it is none")
        average, bits = min(
            (AVERAGES.index(count), bits)
            for count in AVERAGES
            for bits, lasts in enumerate(CONVERSIONS)
            if count * (lasts + CONVERSIONS[0]) >= self.least
        )
        self._config = _ALWAYS | average << 9 | bits << 3
        bus.writeto(self.settings.address, bytes([CONFIG]) + self._config.to_bytes(2, "big"))

    def is_set_up(self) -> bool:
        """As `Ina.is_set_up`."""
        return (self._register(CONFIG) ^ self._config) & _WHAT_COUNTS == 0

    def volts(self) -> tuple[float, float]:
        """As `Ina.volts`."""
        shunt = (self._register(SHUNT) ^ 0x8000) - 0x8000
        return self._register(SUPPLY) * SUPPLY_STEP, shunt * SHUNT_STEP

    def _register(self, number: int) -> int:
        word = bytearray(2)
        self._wires.writeto_then_readfrom(self.settings.address, bytes([number]), word)
        return int.from_bytes(word, "big")
