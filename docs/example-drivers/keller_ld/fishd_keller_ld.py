"""`keller_ld`: pressure and temperature of the water, by a Keller LD on the I2C bus.

The protocol is from the maker: Keller, "Communication protocol 4LD–9LD". The byte 0xAC starts a
measurement of 8 ms. Then five bytes can be read: a status, and pressure and temperature, most
significant byte first. 16384 and 49152 are the ends of the range of pressures.
"""

from typing import Annotated, Any, ClassVar

from fishd.hardware.driver import Problem, Reading, note, unit
from fishd.hardware.sensors.i2c_sensor import I2cSensor, I2cSensorSettings

START = bytes([0xAC])
MEASURING_TIME_S = 0.01
BUSY, FAULTS = 0x20, 0x1C
"""Bits of the status: still measuring; wrong mode or wrong checksum of the memory."""


class KellerLdSettings(I2cSensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Address of the chip, and the range of pressures on its label."""

    address: Annotated[int, note("I2C address; 64 is 0x40.", ge=0x08, le=0x77)] = 64
    lowest: Annotated[float, unit("Pa", "Begin of its range.", ge=-1e5, le=1e8)] = 0.0
    highest: Annotated[float, unit("Pa", "End of its range.", ge=0, le=1e8)] = 3e6


class KellerLd(I2cSensor[KellerLdSettings]):
    """A pressure sensor Keller LD."""

    Settings = KellerLdSettings
    chip = "Keller LD"
    readings: ClassVar = {
        "pressure": Reading("Pa", "Absolute pressure of the water.", 8e4, 3e6),
        "water_temperature": Reading("°C", "Temperature of the water.", 0.0, 50.0),
    }

    @classmethod
    def check(cls, settings: KellerLdSettings, tick: float) -> None:
        """Refuse a range without a length."""
        if settings.highest <= settings.lowest:
            raise Problem(("highest",), f"more than lowest, {settings.lowest:g} Pa, is needed")

    def set_up(self, bus: Any) -> None:
        """Take the bus, and find the chip; raise OSError."""
        bus.try_lock()
        self._i2c = bus
        self._i2c.writeto(self.settings.address, START)
        self.clock.sleep(MEASURING_TIME_S)

    def sample(self) -> dict[str, float]:
        """Measure; raise OSError."""
        settings, answer = self.settings, bytearray(5)
        self._i2c.writeto(settings.address, START)
        self.clock.sleep(MEASURING_TIME_S)
        self._i2c.readfrom_into(settings.address, answer)
        if answer[0] & BUSY or answer[0] & FAULTS:
            raise OSError(f"{self.place} answers with status {answer[0]:#04x}")
        pressure, temperature = answer[1] << 8 | answer[2], answer[3] << 8 | answer[4]
        share = (pressure - 16384) / 32768
        return {
            "pressure": settings.lowest + share * (settings.highest - settings.lowest),
            "water_temperature": 0.05 * ((temperature >> 4) - 24) - 50.0,
        }
