"""What the INA219 and the INA226 of Texas Instruments have in common.

Both measure the voltage over a shunt and that of the supply behind it, one after the other and all
the time, and average by themselves. Their registers for power and current are not used: those know
of one shunt. How they average is lost with the chip's supply, so that is looked at now and then.
"""

import contextlib
import errno
import math
from abc import abstractmethod
from typing import Annotated, Any, ClassVar, TypeVar

from msgspec import Meta

from fishd.core.errors import StartupError
from fishd.core.schema import note, unit
from fishd.hardware import i2c
from fishd.hardware.checks import START_VIRTUAL_PI, Check, Machine, Result, fail, ok, warning
from fishd.hardware.driver import Claim, PowerMeterDriver, PowerMeterSettings, PowerSample

TOLERANCE = 1.15
"""Of the chips' own clocks, and of ours."""
LOWEST_SUPPLY = 3.0
"""Below this [V] no servo moves."""
TRUSTED = 1.0
"""For so long it is believed to average as it was told, unless a transfer fails [s]."""


Shunt = Annotated[
    float, unit("ohm", "Resistance of the shunt in the servo's supply.", ge=1e-4, le=10.0)
]


class InaSettings(PowerMeterSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the chip is, and its shunt."""

    bus: Annotated[i2c.Bus, note("I2C bus: N of /dev/i2c-N.")] = 1
    address: Annotated[
        Annotated[int, Meta(ge=0x40, le=0x4F)],
        note("I2C address, set by the pins A0 and A1; 64 is 0x40."),
    ] = 64
    shunt: Shunt = 0.1


N = TypeVar("N", bound=InaSettings)


class Ina(PowerMeterDriver[N]):
    """An INA on the I2C bus; which one, subclasses know."""

    on_virtual_pi = True
    transport = "i2c_power"
    chip: ClassVar[str]
    """Its name."""
    full_scale: ClassVar[float]
    """Largest voltage over the shunt that it tells, ± [V]."""
    _bus: Any = None
    _trusted_until = -math.inf

    @property
    def least(self) -> float:
        """How long it must measure for each value, so that each is read once at least [s]."""
        return TOLERANCE * self.interval

    @property
    def place(self) -> str:
        """Address and bus."""
        return f"the {self.chip} at {self.settings.address:#04x} on /dev/i2c-{self.settings.bus}"

    def open(self) -> None:
        """Open the bus, find the chip and set it up; raises OSError."""
        bus = i2c.open_bus(self.settings.bus)
        try:
            self.set_up(bus)
        except BaseException:
            i2c.close_bus(bus)
            raise
        self._bus = bus

    @abstractmethod
    def set_up(self, bus: Any) -> None:
        """Let it measure for `least` or longer for each value; raises OSError."""

    @abstractmethod
    def is_set_up(self) -> bool:
        """Whether the chip still measures as `set_up` told it to; raises OSError."""

    @abstractmethod
    def volts(self) -> tuple[float, float]:
        """Voltage of the supply behind the shunt, and over the shunt [V]; raises OSError."""

    def sample(self) -> PowerSample:
        """Two registers. Raises OSError, until it is opened anew where the chip was reset."""
        now = self.clock.monotonic()
        trusted_until, self._trusted_until = self._trusted_until, -math.inf  # where this fails
        if now >= trusted_until:
            if not self.is_set_up():
                raise OSError(
                    errno.EIO, f"{self.place} lost its settings: its supply was interrupted"
                )
            trusted_until = now + TRUSTED
        supply, shunt = self.volts()
        self._trusted_until = trusted_until
        current = shunt / self.settings.shunt
        clipped = ""
        if abs(shunt) >= self.full_scale:
            most = self.full_scale / self.settings.shunt
            clipped = f"the {self.chip} ends at {most:.3g} A with a shunt of "
            clipped += f"{self.settings.shunt:g} Ω: a smaller one is needed"
        return PowerSample(self.clock.monotonic(), supply * current, clipped)

    def close(self) -> None:
        """Let go of the bus; never raises, may be called twice. The chip measures on."""
        bus, self._bus = self._bus, None
        if bus is not None:
            i2c.close_bus(bus)

    def explain(self, error: Exception) -> str:
        """What to check."""
        settings = self.settings
        return i2c.explain(error, settings.bus, settings.address, self.chip, "power_meter")

    @classmethod
    def claims(cls, settings: N) -> tuple[Claim, ...]:
        """The bus, which other drivers of the same fishd may use, too."""
        return (i2c.claim(settings.bus),)

    @classmethod
    def checks(cls, settings: N) -> tuple[Check, ...]:
        """That it answers, and what it measures now."""
        return (Check("power meter", lambda machine: cls._check(machine, settings)),)

    @classmethod
    def _check(cls, machine: Machine, settings: N) -> Result:
        from fishd.core.clock import SystemClock
        from fishd.hardware.registry import driver_packages

        if occupied := machine.occupied("reads it: see power in fishctl status"):
            return occupied
        with driver_packages(settings.driver):
            meter = cls(settings, SystemClock(), 0.01)
        try:
            with machine.plugged_in(), contextlib.closing(meter):
                meter.open()
                meter.clock.sleep(2.0 * meter.interval)
                supply, shunt = meter.volts()
        except StartupError as error:
            return fail(str(error), START_VIRTUAL_PI)
        except (OSError, ValueError) as error:
            return fail(
                meter.explain(error),
                f"'i2cdetect -y {settings.bus}' (package i2c-tools) shows who answers",
            )
        amps = shunt / settings.shunt
        seen = f"{supply:.2f} V, {amps * 1e3:.0f} mA at {meter.place}"
        if supply < LOWEST_SUPPLY:
            return warning(
                f"{seen}: no supply of a servo is behind the shunt",
                "switch the servo's supply on; wire its plus to VIN+ and the servo to VIN-",
            )
        if amps < -5e-3:
            return warning(f"{seen}: the current is negative", "swap VIN+ and VIN-")
        return ok(f"{seen}; up to {meter.full_scale / settings.shunt:.3g} A")
