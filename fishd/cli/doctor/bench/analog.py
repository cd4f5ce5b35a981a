"""ADC against pulses, bit rate of the I2C bus, and the oscillator of the ADC."""

import math
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from fishd.cli.doctor.bench.report import Bus, Filter
from fishd.core.clock import Clock, SystemClock
from fishd.hardware import i2c
from fishd.hardware.checks import Result, fail, ok, warning
from fishd.hardware.force_sensor.ads1115 import Ads1115Settings
from fishd.hardware.force_sensor.calibration_fit import student95

SUPPLY_V, SUPPLY_TOLERANCE = 3.3, 0.05
"""Nominal voltage of a pin at level 1 [V], and the tolerated error of the slope, mostly of that."""
FILTER_TIME_S, FILTER_TIME_RANGE_S = 0.1, (0.05, 0.2)
"""Time constant of 10 kΩ and 10 µF, and the tolerated range [s]."""
SETTLING_S, AVERAGING_S = 1.0, 1.0
"""Time from a change of the pulses to the measurement: ten time constants; and its length [s]."""
BARE_WIRE_V = 1.0
"""Spread of the samples of one duty that a filter does not permit [V]."""
MIN_SIGNAL_V = 0.02
"""Rise of the voltage below which no pulses arrive at A0 [V]."""
MAX_RESIDUAL, MAX_OFFSET_V = 0.015, 0.01
"""Tolerated residual, as a fraction of the largest voltage, and tolerated offset [V]."""
CONVERSION_TOLERANCE = 0.1
"""Error of the data rate that the maker of the ADS1115 permits."""

FULL_SCALE_V = 4.096
"""Range of the ADC in the measurement [V]."""
_LONG_READ, _SHORT_READ = 34, 2
"""Lengths of the reads that are compared [bytes]."""
_TRANSFERS, _CONVERSIONS = 200, 20
_RATE, _RATE_BITS = 128, 0b100 << 5
_START_A0 = 0x8000 | 0x4000 | 0x0200 | 0x0100 | 0x0003
"""Config of one conversion of A0 at ±4.096 V: start, input, range, single-shot, comparator off."""
_IDLE = 0x8000


class Sample(NamedTuple):
    """Voltage at A0 at a time between two bounds, counted from the first pulse [s]."""

    earliest: float
    latest: float
    volts: float


@contextmanager
def open_bus(settings: Ads1115Settings) -> Iterator[Any]:
    """Return the bus of the ADC; it is closed at the end."""
    bus = i2c.open_bus(settings.bus)
    try:
        bus.try_lock()
        yield bus
    finally:
        i2c.close_bus(bus)


def measure_bus(bus: Any, address: int, configured: float | None) -> Bus:
    """Return the bit rate from reads of two lengths, and the bounds of a conversion; raise OSError.

    A long read of the chip gives its register and then ones. The median of many differences is
    that of the bits; the rest of a transfer is the same for both.
    """
    durations: dict[int, list[float]] = {_LONG_READ: [], _SHORT_READ: []}
    for _ in range(_TRANSFERS):
        for length, of_length in durations.items():
            buffer = bytearray(length)
            start = time.perf_counter()
            bus.readfrom_into(address, buffer)
            of_length.append(time.perf_counter() - start)
    long, short = (statistics.median(durations[length]) for length in (_LONG_READ, _SHORT_READ))
    byte_time = max((long - short) / (_LONG_READ - _SHORT_READ), 1e-9)
    overhead = short - byte_time * (_SHORT_READ + 1)
    return Bus(9.0 / byte_time, configured, overhead, _measure_conversion(bus, address))


def _measure_conversion(bus: Any, address: int) -> tuple[float, float]:
    """Return bounds of the time of a conversion, as multiples of the nominal time.

    However late this program reads the chip: it was busy for longer than the one bound, and idle
    before the other.
    """
    command = bytes([1, *(_START_A0 | _RATE_BITS).to_bytes(2, "big")])
    busy_until, idle_from = 0.0, math.inf
    word = bytearray(2)
    for _ in range(_CONVERSIONS):
        before = time.perf_counter()
        bus.writeto(address, command)
        after = time.perf_counter()
        while True:
            asked = time.perf_counter()
            bus.readfrom_into(address, word)
            if word[0] << 8 & _IDLE:
                idle_from = min(idle_from, time.perf_counter() - before)
                break
            busy_until = max(busy_until, asked - after)
            if asked - after > 0.1:
                raise TimeoutError("a conversion of the ADS1115 does not end")
    return busy_until * _RATE, idle_from * _RATE


def judge_bus(bus: Bus) -> Result:
    """Return the line about the bit rate."""
    message = f"{bus.bit_rate / 1e3:.0f} kbit/s measured"
    if bus.configured is None:
        return ok(f"{message}; the kernel does not state what is configured")
    message += f", {bus.configured / 1e3:.0f} configured"
    if bus.bit_rate < 0.8 * bus.configured:
        return warning(
            f"{message}: slower",
            "look for a lowered core clock (Pi 3 and 4) and for pull-ups that are too weak",
        )
    return ok(message)


def judge_conversion(bus: Bus) -> Result:
    """Return the line about the oscillator of the ADC."""
    assert bus.conversion
    low, high = bus.conversion
    message = f"a conversion takes {low:.3f} to {high:.3f} times its nominal time"
    if high < 1.0 / (1.0 + CONVERSION_TOLERANCE) or low > 1.0 / (1.0 - CONVERSION_TOLERANCE):
        return fail(f"{message}, its maker permits ±10 %", "replace the ADS1115")
    return ok(f"{message}; its maker permits ±10 %")


def measure_filter(
    read_volts: Callable[[], float],
    write: Callable[[float], None],
    widths: list[float],
    frame: float,
    tick: float,
    clock: Clock | None = None,
) -> Filter | Result:
    """Return the line of voltage over duty, or what is wrong with the wire.

    read_volts: converts A0; raises OSError
    write: sends a pulse [µs], called once per tick; there are none before the first call
    widths: pulses to send [µs]
    frame: their period [s]
    """
    clock = clock or SystemClock()

    def samples(width: float, seconds: float) -> list[Sample]:
        start = clock.monotonic()
        if width:
            write(width)
        written = now = clock.monotonic()
        next_write = start + tick
        taken: list[Sample] = []
        while not taken or now - start < seconds:
            if width and now >= next_write:
                write(width)
                next_write = now + tick
            asked = clock.monotonic()
            volts = read_volts()
            now = clock.monotonic()
            taken.append(Sample(asked - written, now - start, volts))
        return taken

    samples(0.0, SETTLING_S)
    duties, volts = [0.0], [_mean(samples(0.0, AVERAGING_S))]
    rise: list[Sample] = []
    for width in widths:
        settling = samples(width, SETTLING_S)
        rise = rise or settling
        measured = samples(width, AVERAGING_S)
        values = [sample.volts for sample in measured]
        if max(values) - min(values) > BARE_WIRE_V:
            return fail(
                f"A0 jumps by {max(values) - min(values):.1f} V within a second: the wire leads to "
                "it without the resistor and the capacitor",
                "put 10 kΩ into the wire, and 10 µF from A0 to GND",
            )
        duties.append(width * 1e-6 / frame)
        volts.append(_mean(measured))
        if volts[1] - volts[0] < MIN_SIGNAL_V:
            return fail(
                f"A0 stays at {volts[0]:+.3f} V while there are pulses: no wire leads to it",
                "connect A0 as drawn, and take the amplifier off it",
            )
    time_constant = _time_constant(rise, volts[0], volts[1])
    x, y = np.array(duties), np.array(volts)
    slope, offset = np.polyfit(x, y, 1)
    residuals = y - (slope * x + offset)
    freedom = len(x) - 2
    deviation = math.sqrt(float(residuals @ residuals) / freedom)
    slope_error = deviation / math.sqrt(float(((x - x.mean()) ** 2).sum()))
    return Filter(
        float(slope),
        student95(freedom) * slope_error,
        float(offset),
        float(np.abs(residuals).max()),
        time_constant,
        duties,
        volts,
    )


def judge_filter(measured: Filter) -> Result:
    """Return the line about the ADC and the pulses."""
    level, error = measured.high_level, measured.high_level_ci95
    message = (
        f"A0 follows the duty of the pulses with {level:.3f} ± {error:.3f} V (a pin at "
        f"{SUPPLY_V} V), {measured.residual * 1e3:.1f} mV off a line at most"
    )
    (low, high), (shortest, longest) = measured.time_constant, FILTER_TIME_RANGE_S
    if high < shortest or low > longest:
        return warning(
            f"{message}; the filter takes {low:.2f} to {high:.2f} s, not {FILTER_TIME_S} s",
            "check that it has 10 kΩ and 10 µF: with others the accuracy is unknown",
        )
    if abs(level - SUPPLY_V) - error > SUPPLY_TOLERANCE * SUPPLY_V:
        return fail(
            f"{message}: {level / SUPPLY_V - 1:+.1%}",
            "measure the 3.3 V of the header with a voltmeter: if they are right, it is the ADC",
        )
    if (
        measured.residual > MAX_RESIDUAL * max(measured.volts)
        or abs(measured.offset) > MAX_OFFSET_V
    ):
        return warning(
            f"{message}, {measured.offset * 1e3:+.1f} mV without pulses",
            "check the ground wire between the ADC and the Pi, and that nothing else is at A0",
        )
    return ok(message)


def _mean(samples: list[Sample]) -> float:
    return statistics.fmean(sample.volts for sample in samples)


def _time_constant(rise: list[Sample], before: float, after: float) -> tuple[float, float]:
    """Return bounds of the time in which the voltage has made 63 % of its change [s].

    However late this program reads the chip: the voltage was lower at the one time, and as high at
    the other.
    """
    threshold = before + (1.0 - math.exp(-1.0)) * (after - before)
    low = 0.0
    for sample in rise:
        if sample.volts >= threshold:
            return low, sample.latest
        low = sample.earliest
    return low, SETTLING_S + AVERAGING_S
