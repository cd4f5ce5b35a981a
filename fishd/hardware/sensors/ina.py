"""Drivers of the INA219 and the INA226 of Texas Instruments.

Both chips measure the voltage over a shunt and that of the supply behind it, one after the other
and continuously, and average by themselves. Their registers for power and current are not used:
those assume a certain shunt. The settings of the averages are lost when the chip loses its supply,
so they are read back at intervals.
"""

import errno
import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, TypeVar

from msgspec import Meta

from fishd.core.clock import Clock
from fishd.core.schema import Reading, note, unit
from fishd.hardware.checks import Result, ok, warning
from fishd.hardware.sensors.i2c_sensor import I2cSensor, I2cSensorSettings
from fishd.hardware.settings import POWER

CLOCK_TOLERANCE = 1.15
"""Tolerance of the chips' clocks and of this machine's, as a factor."""
MIN_SUPPLY_V = 3.0
"""Lowest supply voltage with which a servo moves [V]."""
SETTINGS_CHECK_INTERVAL_S = 1.0
"""Time after which the chip's settings are read back, unless a transfer fails before [s]."""
CONVERSION_TIME_219_S = 532e-6
"""Time of a conversion of the INA219 at 12 bits [s]; several make one shunt voltage."""
CONVERSION_TIMES_226_S = (140e-6, 204e-6, 332e-6, 588e-6, 1.1e-3, 2.116e-3, 4.156e-3, 8.244e-3)
"""Time of a conversion of the INA226 for each value of its bits in the config [s]."""
AVERAGE_COUNTS_226 = (1, 4, 16, 64, 128, 256, 512, 1024)
"""Number of conversions in an average for each value of its bits in the config."""

CONFIG, SHUNT, SUPPLY, MANUFACTURER = 0x00, 0x01, 0x02, 0xFE
TEXAS_INSTRUMENTS_ID = 0x5449
_CONTINUOUS_MODE = 0x4007
"""Bits of the config: both voltages, one after the other, continuously."""
_SETTINGS_MASK = 0x0FFF
"""Mask of the config: the bits above have no meaning."""

Shunt = Annotated[
    float, unit("ohm", "Resistance of the shunt in the servo's supply.", ge=1e-4, le=10.0)
]


class InaSettings(I2cSensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Address of the chip, and its shunt."""

    address: Annotated[
        Annotated[int, Meta(ge=0x40, le=0x4F)],
        note("I2C address, set by the pins A0 and A1; 64 is 0x40."),
    ] = 64
    shunt: Shunt = 0.1


N = TypeVar("N", bound=InaSettings)


class Ina(I2cSensor[N]):
    """An INA219 or INA226 on the I2C bus."""

    readings: ClassVar[Mapping[str, Reading]] = {"power": POWER}
    samples_per_tick = 4
    on_virtual_pi = True
    full_scale: ClassVar[float]
    """Largest voltage over the shunt that the chip measures, ± [V]."""
    shunt_step: ClassVar[float]
    """Step of the voltage over the shunt [V]."""
    supply_step: ClassVar[float]
    """Step of the supply voltage [V]."""
    _trusted_until = _measured_at = -math.inf

    @property
    def min_measuring_time(self) -> float:
        """Shortest time to measure for one value, so that every value is read at least once [s]."""
        return CLOCK_TOLERANCE * self.period

    def open(self) -> None:
        """Open the bus and set the chip up; raise OSError if that fails."""
        super().open()
        # Until then, its registers have zeros, or what it measured with other settings.
        self._measured_at = self.clock.monotonic() + 2.0 * self.min_measuring_time

    @abstractmethod
    def set_up(self, bus: Any) -> None:
        """Set the chip to measure `min_measuring_time` or longer for each value; raise OSError."""

    @abstractmethod
    def is_set_up(self) -> bool:
        """Return whether the chip still has the settings of `set_up`; raise OSError."""

    @abstractmethod
    def volts(self) -> tuple[float, float]:
        """Return the voltage of the supply and that over the shunt [V]; raise OSError."""

    def sample(self) -> dict[str, float] | None:
        """Read two registers; return None until the chip has measured once.

        Raises OSError if a transfer fails, after a reset of the chip until it is opened again, and
        at the end of the range.
        """
        now = self.clock.monotonic()
        if now < self._measured_at:
            return None
        # If this method raises, the settings are checked in the next call.
        trusted_until, self._trusted_until = self._trusted_until, -math.inf
        if now >= trusted_until:
            if not self.is_set_up():
                raise OSError(
                    errno.EIO, f"{self.place} lost its settings: its supply was interrupted"
                )
            trusted_until = now + SETTINGS_CHECK_INTERVAL_S
        supply, shunt = self.volts()
        self._trusted_until = trusted_until
        current = shunt / self.settings.shunt
        if abs(shunt) >= self.full_scale:
            largest = self.full_scale / self.settings.shunt
            raise OSError(
                f"the {self.chip} ends at {largest:.3g} A with a shunt of "
                f"{self.settings.shunt:g} Ω: a smaller one is needed"
            )
        return {"power": supply * current}

    def judge(self, values: Mapping[str, float]) -> Result:
        """Do as `SensorDriver.judge`, with voltage and current."""
        supply, shunt = self.volts()
        amps = shunt / self.settings.shunt
        reading = f"{supply:.2f} V, {amps * 1e3:.0f} mA at {self.place}"
        if supply < MIN_SUPPLY_V:
            return warning(
                f"{reading}: no supply of a servo is behind the shunt",
                "switch the servo's supply on; wire its plus to VIN+ and the servo to VIN-",
            )
        if amps < -5e-3:
            return warning(f"{reading}: the current is negative", "swap VIN+ and VIN-")
        return ok(f"{reading}; up to {self.full_scale / self.settings.shunt:.3g} A")


class Ina219Settings(InaSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The INA219 in the servo's supply; common boards have a shunt of 0.1 Ω."""


class Ina219(Ina[Ina219Settings]):
    """An INA219 on the I2C bus; up to 3.2 A with a shunt of 0.1 Ω."""

    Settings = Ina219Settings
    packages = (*I2cSensor.packages, "adafruit-circuitpython-ina219")
    chip = "INA219"
    full_scale = 0.32
    shunt_step, supply_step = 10e-6, 4e-3
    _chip: Any

    def __init__(self, settings: Ina219Settings, clock: Clock, period: float, section: str) -> None:
        """Import the library; raise ImportError if it is not installed."""
        from adafruit_ina219 import INA219

        super().__init__(settings, clock, period, section)
        self._library = INA219

    def set_up(self, bus: Any) -> None:
        """Set up the chip as the library does, but average the shunt's voltage without gaps."""
        self._chip = self._library(bus, self.settings.address)
        doublings = 1
        while (
            doublings < 7 and (2**doublings + 1) * CONVERSION_TIME_219_S < self.min_measuring_time
        ):
            doublings += 1
        self._resolution = 0x8 | doublings  # 2, 4 … 128 samples
        self._chip.shunt_adc_resolution = self._resolution

    def is_set_up(self) -> bool:
        """Do as `Ina.is_set_up`; the other settings are those after a reset."""
        return bool(self._chip.shunt_adc_resolution == self._resolution)

    def volts(self) -> tuple[float, float]:
        """Do as `Ina.volts`."""
        chip = self._chip
        return chip.raw_bus_voltage * self.supply_step, chip.raw_shunt_voltage * self.shunt_step


class Ina226Settings(InaSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The INA226 in the servo's supply; see its board for the value of the shunt."""

    shunt: Shunt = 0.01


class Ina226(Ina[Ina226Settings]):
    """An INA226 on the I2C bus; up to 8.2 A with a shunt of 0.01 Ω.

    It is driven register by register: no maintained library supports the bus that fishd uses.
    """

    Settings = Ina226Settings
    chip = "INA226"
    full_scale = 0.0819
    shunt_step, supply_step = 2.5e-6, 1.25e-3
    _i2c_bus: Any

    def set_up(self, bus: Any) -> None:
        """Set the chip to average the shunt's voltage without gaps, and the supply's briefly."""
        self._i2c_bus = bus
        bus.try_lock()
        if self._register(MANUFACTURER) != TEXAS_INSTRUMENTS_ID:
            raise OSError(errno.ENODEV, f"{self.place} identifies itself as another chip")
        average, bits = min(
            (AVERAGE_COUNTS_226.index(count), bits)
            for count in AVERAGE_COUNTS_226
            for bits, duration in enumerate(CONVERSION_TIMES_226_S)
            if count * (duration + CONVERSION_TIMES_226_S[0]) >= self.min_measuring_time
        )
        self._config = _CONTINUOUS_MODE | average << 9 | bits << 3
        bus.writeto(self.settings.address, bytes([CONFIG]) + self._config.to_bytes(2, "big"))

    def is_set_up(self) -> bool:
        """Do as `Ina.is_set_up`."""
        return (self._register(CONFIG) ^ self._config) & _SETTINGS_MASK == 0

    def volts(self) -> tuple[float, float]:
        """Do as `Ina.volts`."""
        shunt = (self._register(SHUNT) ^ 0x8000) - 0x8000
        return self._register(SUPPLY) * self.supply_step, shunt * self.shunt_step

    def _register(self, number: int) -> int:
        word = bytearray(2)
        self._i2c_bus.writeto_then_readfrom(self.settings.address, bytes([number]), word)
        return int.from_bytes(word, "big")
