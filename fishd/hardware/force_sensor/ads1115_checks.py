"""What `fishctl doctor` looks at where the force sensor is on an ADS1115."""

from typing import TYPE_CHECKING

from fishd.core.errors import MissingPackage, StartupError
from fishd.hardware import i2c
from fishd.hardware.checks import START_VIRTUAL_PI, Check, Machine, Result, fail, ok, warning

if TYPE_CHECKING:
    from fishd.hardware.force_sensor.ads1115 import Ads1115Settings

SUPPLY = 3.3
"""Of the ADC and of the amplifiers, as docs/how-to/wiring.md has them [V]."""

_CONFIG, _HIGH_THRESHOLD = 1, 3
_RESET = 0x8583
_OURS, _OUR_BITS = 0x0113, 0x011F
"""Single-shot, window comparator, off: no other program leaves that behind."""
_ADS1115, _ADS1015 = 0x7FFF, 0x7FF0


def checks(settings: "Ads1115Settings") -> tuple[Check, ...]:
    """Of amplifier and chip."""
    return (
        Check("amplifier", lambda machine: _amplifier(settings)),
        Check("adc", lambda machine: _chip(machine, settings)),
    )


def _amplifier(settings: "Ads1115Settings") -> Result:
    """Whether one at the end of its supply can be told from a force."""
    low, high = settings.saturation_low, settings.saturation_high
    if settings.full_scale > SUPPLY and high is None:
        return warning(
            f"full_scale is {settings.full_scale:g} V: an amplifier of {SUPPLY:g} V is at its end "
            "before the ADC clips, and that would pass for a force",
            "set force_sensor.saturation_high to what the amplifier can give, 3.2 V perhaps",
        )
    single = [c for c in (settings.channel_x, settings.channel_y) if "-" not in c]
    if single and (low is None or low < 0.0):
        return warning(
            f"{' and '.join(single)} against ground: an amplifier at its lower end, near 0 V, "
            "would pass for a force",
            "set force_sensor.saturation_low to the least that it can give, 0.1 V perhaps",
        )
    ends = [f"{end:+g} V" for end in (low, high) if end is not None]
    told = f"; at its end at {' and '.join(ends)}" if ends else ""
    return ok(f"±{settings.full_scale:g} V{told}")


def _chip(machine: Machine, settings: "Ads1115Settings") -> Result:
    """An ADS1115 has 16 bits in its threshold where the ADS1015 has 12."""
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
            f"'i2cdetect -y {settings.bus}' (package i2c-tools) shows who answers",
        )
    if threshold == _ADS1015:
        return fail(f"an ADS1015 answers at {place}", "fishd needs an ADS1115: it has 16 bits")
    if config == _RESET and threshold == _ADS1115:
        return ok(f"an ADS1115 answers at {place}, as after power-on")
    if config & _OUR_BITS == _OURS and threshold == _ADS1115:
        return ok(f"an ADS1115 answers at {place}, as fishd left it")
    return warning(
        f"what answers at {place} has config {config:#06x} and threshold {threshold:#06x}: another "
        "program uses it, or it is no ADS1115",
        "stop other programs that use the chip, and switch its power off and on",
    )


def _registers(number: int, address: int) -> tuple[int, int]:
    """The chip's config and high threshold; nothing of it is changed. Raises OSError."""
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
