"""Checks of `fishctl doctor` of a force sensor on an ADS1115."""

from typing import TYPE_CHECKING

from fishd.core.errors import MissingPackage, StartupError
from fishd.hardware import i2c
from fishd.hardware.checks import START_VIRTUAL_PI, Check, Machine, Result, fail, ok, warning

if TYPE_CHECKING:
    from fishd.hardware.force_sensor.ads1115 import Ads1115Settings

SUPPLY_V = 3.3
"""Supply of the ADC and of the amplifiers in docs/how-to/wiring.md [V]."""

_CONFIG, _HIGH_THRESHOLD = 1, 3
_RESET_CONFIG = 0x8583
_FISHD_CONFIG, _FISHD_CONFIG_MASK = 0x0113, 0x011F
"""Single-shot, window comparator, off: a configuration that no other program leaves."""
_ADS1115_THRESHOLD, _ADS1015_THRESHOLD = 0x7FFF, 0x7FF0


def checks(settings: "Ads1115Settings") -> tuple[Check, ...]:
    """Return the checks of amplifier and chip."""
    return (
        Check("amplifier", lambda machine: _amplifier(settings)),
        Check("adc", lambda machine: _chip(machine, settings)),
    )


def _amplifier(settings: "Ads1115Settings") -> Result:
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


def _chip(machine: Machine, settings: "Ads1115Settings") -> Result:
    """Check which chip answers: the threshold has 16 bits in an ADS1115, 12 in an ADS1015."""
    if occupied := machine.occupied("owns the bus; see force"):
        return occupied
    place = f"{settings.address:#04x} on /dev/i2c-{settings.bus}"
    try:
        with machine.plugged_in():
            config, threshold = _registers(settings.bus, settings.address)
    except MissingPackage:
        raise
    except StartupError as error:
        return fail(str(error), START_VIRTUAL_PI)
    except (OSError, ValueError) as error:
        return fail(
            i2c.explain(error, settings.bus, settings.address, "ADS1115", "force_sensor"),
            f"'i2cdetect -y {settings.bus}' (package i2c-tools) lists which addresses answer",
        )
    if threshold == _ADS1015_THRESHOLD:
        return fail(f"an ADS1015 answers at {place}", "fishd needs an ADS1115: it has 16 bits")
    if config == _RESET_CONFIG and threshold == _ADS1115_THRESHOLD:
        return ok(f"an ADS1115 answers at {place}, as after power-on")
    if config & _FISHD_CONFIG_MASK == _FISHD_CONFIG and threshold == _ADS1115_THRESHOLD:
        return ok(f"an ADS1115 answers at {place}, as fishd left it")
    return warning(
        f"what answers at {place} has config {config:#06x} and threshold {threshold:#06x}: another "
        "program uses it, or it is not an ADS1115",
        "stop other programs that use the chip, and switch its power off and on",
    )


def _registers(number: int, address: int) -> tuple[int, int]:
    """Return the chip's config and high threshold without changing them; raise OSError."""
    bus = i2c.open_bus(number)
    try:
        bus.try_lock()
        values = []
        for register in (_CONFIG, _HIGH_THRESHOLD):
            word = bytearray(2)
            bus.writeto_then_readfrom(address, bytes([register]), word)
            values.append(int.from_bytes(word, "big"))
    finally:
        i2c.close_bus(bus)
    return values[0], values[1]
