"""Dual force sensor on an ADS1115: two inputs of one chip, converted in turn.

The order is X Y Y X X Y …, so the lag of the second sample of a pair cancels out in their mean.
"""

import math
from typing import TYPE_CHECKING, Annotated, Any, Literal

from msgspec import Meta

from fishd.core.clock import Clock
from fishd.core.errors import MissingPackage, StartupError
from fishd.core.schema import Problem, note, unit
from fishd.hardware import i2c
from fishd.hardware.checks import START_VIRTUAL_PI, Check, Machine, Result, fail, ok, warning
from fishd.hardware.driver import Claim, ForceSensorDriver, Pair
from fishd.hardware.settings import ForceSensorSettings

if TYPE_CHECKING:
    from fishd.hardware.force_sensor.ads1115_single_shot import SingleShot

Channel = Literal["A0", "A1", "A2", "A3", "A0-A1", "A0-A3", "A1-A3", "A2-A3"]
"""Input of the ADS1115: a pin against ground, or the difference of two pins."""
I2cAddress = Annotated[int, Meta(ge=0x48, le=0x4B)]
"""I2C address of an ADS1115."""
FULL_SCALES_V = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256)
"""Ranges of the ADS1115, ± [V]."""
ADC_STEPS = 32768
"""Number of steps of the ADC from zero to full scale."""
MAX_SAMPLE_PERIODS = 1.25
"""Longest time of a conversion with its transfers, as a multiple of 1 / data rate."""
MIN_PAIRS_PER_CONVERSION = 160 / 860
"""Lowest number of pairs per nominal conversion on a bus of 400 kbit/s: 160 pairs a second at 860
samples a second."""
SUPPLY_V = 3.3
"""Supply of the ADC and of the amplifiers in docs/how-to/wiring.md [V]."""

_CONFIG, _THRESHOLD = 1, 3
_RESET_CONFIG = 0x8583
_FISHD_CONFIG, _FISHD_CONFIG_MASK = 0x0113, 0x011F
"""Single-shot, window comparator, off: a configuration that no other program leaves."""
_RESET_THRESHOLD = 0x7FFF
_LOW_BITS = 0x000F
"""Bits of codes and thresholds that an ADS1015 does not have: they are always 0."""


class Ads1115Settings(ForceSensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The ADS1115 that the dual force sensor is wired to."""

    bus: Annotated[i2c.Bus, note("I2C bus: N of /dev/i2c-N.")] = 1
    address: Annotated[I2cAddress, note("I2C address, set by the ADDR pin; 72 is 0x48.")] = 72
    channel_x: Annotated[Channel, note("Input that carries F_x.")] = "A0-A1"
    channel_y: Annotated[Channel, note("Input that carries F_y.")] = "A2-A3"
    full_scale: Annotated[
        float,
        unit(
            "V",
            "Range of the inputs, ± this: 6.144, 4.096, 2.048, 1.024, 0.512 or 0.256.",
            gt=0,
            le=6.144,
        ),
    ] = 2.048
    saturation_low: Annotated[
        Annotated[float, Meta(ge=-6.144, le=6.144)] | None,
        unit(
            "V",
            "Voltage of the input at or below which its amplifier counts as saturated, as if the "
            "ADC had clipped; such as 0.1 for A0 alone; null for none.",
        ),
    ] = -3.2
    saturation_high: Annotated[
        Annotated[float, Meta(ge=-6.144, le=6.144)] | None,
        unit(
            "V",
            "Voltage of the input at or above which its amplifier counts as saturated; null for "
            "none.",
        ),
    ] = 3.2
    data_rate: Annotated[
        Literal[8, 16, 32, 64, 128, 250, 475, 860], unit("1/s", "Conversions per second.")
    ] = 860


class Ads1115(ForceSensorDriver[Ads1115Settings]):
    """An ADS1115 on the I2C bus."""

    Settings = Ads1115Settings
    packages = ("adafruit-blinka", "adafruit-circuitpython-ads1x15", "adafruit-extended-bus")
    on_virtual_pi = True
    transport = "i2c"

    def __init__(self, settings: Ads1115Settings, clock: Clock) -> None:
        """Import the library and open nothing yet; raise ImportError if it is not installed."""
        from fishd.hardware.force_sensor import ads1115_single_shot as library

        super().__init__(settings, clock)
        self._single_shot = library.SingleShot
        # A conversion continues if the transfer that reads it fails. Until its end the chip
        # ignores a start, and would then return a sample of the other channel.
        self.settling = library.CONVERSION_TIMEOUT_PERIODS / settings.data_rate + 1e-3
        self.names = f"F_x (channel {settings.channel_x})", f"F_y (channel {settings.channel_y})"
        self._duration = 1.0 / settings.data_rate
        self._step = settings.full_scale / ADC_STEPS
        low, high = settings.saturation_low, settings.saturation_high
        self._lowest = -ADC_STEPS if low is None else max(-ADC_STEPS, math.floor(low / self._step))
        self._saturated = ADC_STEPS if high is None else math.ceil(high / self._step)
        self._highest = self._largest = ADC_STEPS - 1
        self._in_doubt = True
        self._y_first = False
        self._first: tuple[float, int] | None = None
        self._bus: Any = None
        self._chip: SingleShot
        self._x: Any
        self._y: Any

    @property
    def place(self) -> str:
        """Chip, address and bus, for messages."""
        return f"the ADS1115 at {self.settings.address:#04x} on /dev/i2c-{self.settings.bus}"

    def open(self) -> None:
        """Open the bus, find the chip and look which one it is; raise OSError if that fails."""
        settings = self.settings
        bus = i2c.open_bus(settings.bus)
        try:
            self._chip = self._single_shot(
                bus, settings.address, settings.full_scale, settings.data_rate, self.clock
            )
            is_coarse = not self._chip.high_threshold() & _LOW_BITS
        except BaseException:
            i2c.close_bus(bus)
            raise
        self._x = self._chip.input(settings.channel_x)
        self._y = self._chip.input(settings.channel_y)
        self._bus = bus
        self._largest = ADC_STEPS - 1 - (_LOW_BITS if is_coarse else 0)
        self._highest = min(self._saturated, self._largest)
        self.limitations = (_describe_ads1015(settings),) if is_coarse else ()

    def sample(self) -> Pair | None:
        """Convert once; return a pair after every second conversion. Raises OSError."""
        first, self._first = self._first, None
        if self._in_doubt:
            first = None
            self._chip.check_idle()
        self._in_doubt = True  # until the conversion has ended
        code = (self._y if self._y_first == (first is None) else self._x).value
        self._in_doubt, started = False, self._chip.started
        if first is None:
            self._first = started, code
            return None
        first_started, first_code = first
        x, y = (code, first_code) if self._y_first else (first_code, code)
        self._y_first = not self._y_first
        clipped = self._clipped(0, x) or self._clipped(1, y)
        return Pair(
            first_started, started + self._duration, x * self._step, y * self._step, clipped
        )

    def close(self) -> None:
        """Close the bus; never raises, may be called twice."""
        bus, self._bus = self._bus, None
        if bus is not None:
            del self._chip, self._x, self._y
            i2c.close_bus(bus)

    def explain(self, error: Exception) -> str:
        """Return one line that says what went wrong and what to check."""
        settings = self.settings
        return i2c.explain(error, settings.bus, settings.address, "ADS1115", "force_sensor")

    @classmethod
    def pair_rate(cls, settings: Ads1115Settings) -> float:
        """Return the lowest rate of pairs on a bus of 400 kbit/s [1/s]."""
        return MIN_PAIRS_PER_CONVERSION * settings.data_rate

    @classmethod
    def check(cls, settings: Ads1115Settings, tick: float) -> None:
        """Refuse an impossible range, one input for both forces, or too slow a rate."""
        check_full_scale(settings.full_scale)
        low, high = settings.saturation_low, settings.saturation_high
        if low is not None and high is not None and low >= high:
            raise Problem(
                ("saturation_low",),
                f"{low:g} is not valid: less than saturation_high, {high:g} V, is needed",
            )
        if settings.channel_x == settings.channel_y:
            raise Problem(("channel_y",), f"'{settings.channel_y}' is already channel_x")
        longest = 2 * MAX_SAMPLE_PERIODS / settings.data_rate
        if longest > tick:
            raise Problem(
                ("data_rate",),
                f"{settings.data_rate} is not valid: a pair of samples would take up to "
                f"{longest * 1e3:.1f} ms, longer than a tick of {tick * 1e3:g} ms",
            )

    @classmethod
    def claims(cls, settings: Ads1115Settings) -> tuple[Claim, ...]:
        """Return the claim of the bus."""
        return (i2c.claim(settings.bus),)

    @classmethod
    def checks(cls, settings: Ads1115Settings) -> tuple[Check, ...]:
        """Return the checks of bus, amplifier and chip."""
        return (
            *i2c.checks(settings.bus, "force_sensor"),
            Check("amplifier", lambda machine: _amplifier(settings)),
            Check("adc", lambda machine: _chip(machine, settings)),
        )

    def _clipped(self, channel: int, code: int) -> str | None:
        """Return why a code is clipped, by the ADC or by its amplifier; None if it is not."""
        if self._lowest < code < self._highest:
            return None
        name = self.names[channel]
        if code in (-ADC_STEPS, self._largest):
            return f"{name} is clipped at {math.copysign(self.settings.full_scale, code):+g} V"
        key = "saturation_high" if code >= self._highest else "saturation_low"
        volts = code * self._step
        return f"{name} is at {volts:+.4g} V: the amplifier is at its end (force_sensor.{key})"


def check_full_scale(full_scale: float) -> None:
    """Raise `Problem` unless this is a range of the chip, ± [V]."""
    if full_scale not in FULL_SCALES_V:
        permitted = ", ".join(f"{scale:g}" for scale in FULL_SCALES_V)
        raise Problem(
            ("full_scale",), f"{full_scale:g} is not valid: one of {permitted} V is needed"
        )


def _amplifier(settings: Ads1115Settings) -> Result:
    """Check that an amplifier at the end of its supply would not count as a force."""
    low, high = settings.saturation_low, settings.saturation_high
    if settings.full_scale > SUPPLY_V and high is None:
        return warning(
            f"full_scale is {settings.full_scale:g} V: an amplifier of {SUPPLY_V:g} V saturates "
            "before the ADC clips, and that would count as a force",
            "set force_sensor.saturation_high to the highest voltage of the amplifier, about 3.2 V",
        )
    single = [c for c in (settings.channel_x, settings.channel_y) if "-" not in c]
    if single and (low is None or low < 0.0):
        return warning(
            f"{' and '.join(single)} against ground: an amplifier at its lower end, near 0 V, "
            "would count as a force",
            "set force_sensor.saturation_low to the lowest voltage of the amplifier, about 0.1 V",
        )
    ends = [f"{end:+g} V" for end in (low, high) if end is not None]
    limits = f"; the amplifier saturates at {' and '.join(ends)}" if ends else ""
    return ok(f"±{settings.full_scale:g} V{limits}")


def _describe_ads1015(settings: Ads1115Settings) -> str:
    """Return one line about an ADS1015 in the place of the ADS1115, with its step."""
    return (
        f"the chip at {settings.address:#04x} on /dev/i2c-{settings.bus} is an ADS1015, not an "
        f"ADS1115: it has 12 bits, so its step is {settings.full_scale / 2.048:g} mV, 16 times as "
        "coarse; replace it"
    )


def _chip(machine: Machine, settings: Ads1115Settings) -> Result:
    """Check which chip answers: it needs the 16 bits of an ADS1115, not the 12 of an ADS1015."""
    remedy = "fishd needs an ADS1115: it has 16 bits"
    if occupied := machine.occupied("owns the bus; see force"):
        coarse = _describe_ads1015(settings)
        return fail(coarse, remedy) if coarse in machine.limitations else occupied
    place = f"{settings.address:#04x} on /dev/i2c-{settings.bus}"
    try:
        with machine.plugged_in():
            config, threshold, is_coarse = _identify(settings.bus, settings.address)
    except MissingPackage:
        raise
    except StartupError as error:
        return fail(str(error), START_VIRTUAL_PI)
    except (OSError, ValueError) as error:
        return fail(
            i2c.explain(error, settings.bus, settings.address, "ADS1115", "force_sensor"),
            f"'i2cdetect -y {settings.bus}' (package i2c-tools) lists which addresses answer",
        )
    if is_coarse:
        return fail(_describe_ads1015(settings), remedy)
    if config == _RESET_CONFIG and threshold == _RESET_THRESHOLD:
        return ok(f"an ADS1115 answers at {place}, as after power-on")
    if config & _FISHD_CONFIG_MASK == _FISHD_CONFIG and threshold == _RESET_THRESHOLD:
        return ok(f"an ADS1115 answers at {place}, as fishd left it")
    return warning(
        f"what answers at {place} has config {config:#06x} and threshold {threshold:#06x}: another "
        "program uses it, or it is not an ADS1115",
        "stop other programs that use the chip, and switch its power off and on",
    )


def _identify(number: int, address: int) -> tuple[int, int, bool]:
    """Return the chip's config and high threshold, and whether it is an ADS1015; raise OSError."""
    bus = i2c.open_bus(number)
    try:
        config, threshold = (_read(bus, address, register) for register in (_CONFIG, _THRESHOLD))
        is_coarse = not threshold & _LOW_BITS
        if is_coarse:  # or another program has cleared these bits: then they can be set
            _write(bus, address, _THRESHOLD, threshold | _LOW_BITS)
            is_coarse = not _read(bus, address, _THRESHOLD) & _LOW_BITS
            _write(bus, address, _THRESHOLD, threshold)
        return config, threshold, is_coarse
    finally:
        i2c.close_bus(bus)


def _read(bus: Any, address: int, register: int) -> int:
    word = bytearray(2)
    bus.writeto_then_readfrom(address, bytes([register]), word)
    return int.from_bytes(word, "big")


def _write(bus: Any, address: int, register: int, word: int) -> None:
    bus.writeto(address, bytes([register, *word.to_bytes(2, "big")]))
