"""Checks of the force sensor, from amplifier to force; a running fishd is asked instead."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from fishd.cli.checks.base import Check, Context, Result, fail, ok, warning
from fishd.clock import SystemClock
from fishd.errors import MissingPackage, SensorError, StartupError
from fishd.hardware.calibration import ForceCalibration
from fishd.hardware.i2c_errors import explain

TRIAL = 1.0
"""How long the sensor is tried [s]."""
FEWEST_PAIRS = 8
"""Pairs of samples in a tick of 50 ms at 860 samples/s, below which something slows the bus."""

_CONFIG, _HIGH_THRESHOLD = 1, 3
_RESET = 0x8583
_OURS, _OUR_BITS = 0x0113, 0x011F
"""Single-shot, window comparator, off: no other program leaves that behind."""
_ADS1115, _ADS1015 = 0x7FFF, 0x7FF0

_START = "fishctl virtual-pi run"

SUPPLY = 3.3
"""Of the ADC and of the amplifiers, as docs/wiring.md has them [V]."""


def amplifier(context: Context) -> Result:
    """Whether one at the end of its supply can be told from a force."""
    settings = context.config.force_sensor
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


def chip(context: Context) -> Result:
    """An ADS1115 has 16 bits in its threshold where the ADS1015 has 12."""
    if occupied := context.occupied("owns the bus; see force"):
        return occupied
    settings = context.config.force_sensor
    place = f"{settings.address:#04x} on /dev/i2c-{settings.bus}"
    try:
        with plugged_in(context):
            config, threshold = _registers(settings.bus, settings.address)
    except MissingPackage:
        raise
    except StartupError as error:
        return fail(str(error), _START)
    except (OSError, ValueError) as error:
        return fail(
            explain(error, settings.bus, settings.address),
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


def force(context: Context) -> Result:
    """What the running daemon measures; without one, the same driver for a second."""
    if context.running:
        return _force_of_daemon(context)
    if occupied := context.occupied("owns the bus"):
        return occupied
    from fishd.hardware.ads1115 import Ads1115Sensor

    tick = context.config.tick
    try:
        with plugged_in(context), ExitStack() as stack:
            settings = context.config.force_sensor
            sensor = Ads1115Sensor(
                settings, ForceCalibration(), SystemClock(), threaded=True, tick=tick
            )
            stack.callback(sensor.close)
            trials = list(_windows(sensor, tick))
    except MissingPackage:
        raise
    except StartupError as error:
        return fail(str(error), _START)
    except SensorError as error:
        return fail(str(error), "mend what the lines above say first")
    samples, suspicions = [n for n, _ in trials], {why for _, why in trials if why}
    per_tick = sum(samples) / len(samples)
    if not per_tick:
        return fail("the ADS1115 answers, but delivers nothing", "switch its power off and on")
    if suspicions:
        return fail(
            f"not to be believed: {'; '.join(sorted(suspicions))}",
            "check the wires of the sensor, its amplifier, and force_sensor.full_scale",
        )
    return _enough(per_tick, context, "not clipped, not frozen")


def _force_of_daemon(context: Context) -> Result:
    assert context.running
    status, tick, _, _ = context.running
    if tick is None:
        return fail(f"fishd runs, but {status.telemetry} is silent", "fishctl status; a firewall?")
    if status.reason and status.reason.code.startswith("sensor"):
        return fail(
            f"{status.reason.code}: {status.reason.message}",
            "mend the cause, then fishctl clear-fault",
        )
    survived = ", ".join(
        f"{n} {name}" for name, n in status.counters.items() if "i2c" in name and n
    )
    if tick.samples == 0:
        return warning(
            f"no new sample in the latest tick, the newest is {tick.age_ms:.0f} ms old",
            "fishctl watch; check the wires if this goes on",
        )
    return _enough(
        tick.samples,
        context,
        f"the newest {tick.age_ms:.0f} ms old, {survived or 'no I2C errors'}",
    )


def _enough(per_tick: float, context: Context, details: str) -> Result:
    """Compare with what a healthy bus gives at this data rate and tick."""
    config = context.config
    expected = FEWEST_PAIRS * config.force_sensor.data_rate / 860 * config.tick / 0.05
    message = f"{per_tick:.1f} pairs of samples per tick, {details}"
    if per_tick < expected:
        return warning(
            f"{message}: fewer than the {expected:.1f} of a healthy 400 kbit/s bus",
            "make the bus faster, and stop what else uses it or loads the processor",
        )
    return ok(message)


def _windows(sensor: Any, tick: float) -> Iterator[tuple[int, str]]:
    """Samples and suspicion of each window; the first, in which the sampler starts, is left out."""
    latest: SensorError | None = None
    began = time.monotonic()
    first = True
    while time.monotonic() - began < TRIAL:
        time.sleep(tick)
        try:
            measurement = sensor.read(time.monotonic())
        except SensorError as error:
            latest = error
            continue
        if not first:
            yield measurement.samples, measurement.suspect
        first, latest = False, None
    if latest or first:
        raise latest or SensorError("the sensor says nothing")


@contextmanager
def plugged_in(context: Context) -> Iterator[None]:
    """Where the robot is a virtual Pi: with its bus in this process. Raises `StartupError`."""
    from fishd.robots import plug_in_virtual_pi

    with ExitStack() as stack:
        if context.config.robot == "virtual-pi":
            plug_in_virtual_pi(context.config, stack)
        yield


def _registers(number: int, address: int) -> tuple[int, int]:
    """The chip's config and high threshold; nothing of it is changed. Raises OSError."""
    from fishd.hardware.single_shot import close_bus, open_bus

    bus = open_bus(number)
    try:
        bus.try_lock()
        values = []
        for register in (_CONFIG, _HIGH_THRESHOLD):
            word = bytearray(2)
            bus.writeto_then_readfrom(address, bytes([register]), word)
            values.append(int.from_bytes(word, "big"))
    finally:
        close_bus(bus)
    return values[0], values[1]


CHECKS = (
    Check("amplifier", amplifier, ("pi", "virtual-pi")),
    Check("adc", chip, ("pi", "virtual-pi")),
    Check("force", force, ("pi", "virtual-pi")),
)
