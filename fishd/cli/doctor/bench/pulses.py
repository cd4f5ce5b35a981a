"""Pulses of a servo, from the edges of a pin that a wire connects to the servo's pin."""

import statistics
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from fishd.cli.doctor.bench.report import Ending, Pulses
from fishd.hardware.checks import Result, fail, ok, warning

if TYPE_CHECKING:  # it needs pigpio
    from fishd.hardware.servo.pigpio_edges import Edge

JITTER_US = 15.0
"""Deviation of 99 % of widths and periods up to which pulses are good: three steps of pigpio."""
MAX_JITTER_US = 50.0
"""Deviation above which a servo visibly trembles."""
NEUTRAL_US = 6.0
"""Largest difference of a pulse at neutral from the width of neutral: a step, and a tick."""
ENDING_MARGIN_S = 0.1
"""Time that the end of the pulses may take longer than the countdown."""
HOLD_S = 0.5
"""Time for which the countdown holds neutral before the pulses end [s]."""


class Pulse(NamedTuple):
    """One pulse."""

    start: float
    """[s]"""
    width: float
    """[µs]"""


def find_pulses(edges: "Sequence[Edge]") -> list[Pulse]:
    """Return the whole pulses within edges."""
    return [
        Pulse(rise.time, (fall.time - rise.time) * 1e6)
        for rise, fall in pairwise(edges)
        if rise.level and not fall.level
    ]


def summarise(pulses: Sequence[Pulse], sent: Sequence[float]) -> Pulses:
    """Return the figures of at least three pulses; sent: widths that fishd sent [µs]."""
    periods = [after.start - before.start for before, after in pairwise(pulses)]
    frame = statistics.median(periods)
    frames = [max(1, round(period / frame)) for period in periods]
    whole = [period for period, count in zip(periods, frames, strict=True) if count == 1]
    mean = statistics.fmean(whole)
    jitter = sorted(abs(period - mean) * 1e6 for period in whole)
    errors = [pulse.width - min(sent, key=lambda w: abs(pulse.width - w)) for pulse in pulses]
    deviations = sorted(abs(error) for error in errors)
    return Pulses(
        count=len(pulses),
        missing=sum(frames) - len(frames),
        width=statistics.fmean(pulse.width for pulse in pulses),
        error=statistics.fmean(errors),
        deviation_p99=find_p99(deviations),
        deviation_max=deviations[-1],
        period=mean * 1e3,
        jitter_p99=find_p99(jitter),
        jitter_max=jitter[-1],
    )


def find_p99(ascending: Sequence[float]) -> float:
    """Return the value that 99 % of the sorted values do not exceed."""
    return ascending[min(len(ascending) - 1, int(0.99 * len(ascending)))]


def judge(pulses: Pulses) -> Result:
    """Return the line about the pulses of one part of the swim."""
    message = (
        f"{pulses.count} pulses, 99 % within {pulses.deviation_p99:.0f} µs of what fishd sent "
        f"(at most {pulses.deviation_max:.0f}), every {pulses.period:.3f} ms ± "
        f"{pulses.jitter_p99:.0f} µs (at most {pulses.jitter_max:.0f})"
    )
    if pulses.missing:
        return fail(f"{message}; {pulses.missing} are missing", "check the wires, and the load")
    worst = max(pulses.deviation_p99, pulses.jitter_p99)
    if worst > MAX_JITTER_US:
        return fail(message, "the servo trembles: use pigpiod or the kernel's PWM")
    if worst > JITTER_US:
        return warning(message, "stop other programs that use DMA, PWM or sound")
    return ok(message)


def find_ending(pulses: Sequence[Pulse], neutral: float, end: float, now: float) -> Ending:
    """Return when the pulses came to neutral and when they ended.

    end: time of the cause, from which both are counted [s]
    now: time up to which the pulses were observed [s]
    """
    first_neutral = None
    for pulse in reversed(pulses):
        if abs(pulse.width - neutral) > NEUTRAL_US:
            break
        first_neutral = pulse.start
    last = pulses[-1].start + pulses[-1].width * 1e-6 if pulses else end
    goes_on = now - last < ENDING_MARGIN_S
    return Ending(
        None if first_neutral is None else max(0.0, first_neutral - end),
        None if goes_on else max(0.0, last - end),
    )


def judge_ending(ending: Ending, promised: float, cause: str) -> Result:
    """Return the line about the end of the pulses.

    promised: longest time until neutral [s]; cause: what ended fishd
    """
    remedy = "do not swim this robot: its servo would stay deflected; please report this"
    if ending.off is None:
        return fail(f"the pulses go on after {cause}", remedy)
    if ending.neutral is None:
        return fail(
            f"{ending.off:.2f} s after {cause} the pulses ended, but not at neutral", remedy
        )
    message = (
        f"{ending.neutral:.3f} s after {cause} the servo was at neutral, its pulses ended after "
        f"{ending.off:.3f} s; at most {promised:.2f} and {promised + HOLD_S:.2f} s are promised"
    )
    late = max(ending.neutral - promised, ending.off - promised - HOLD_S)
    return fail(message, remedy) if late > ENDING_MARGIN_S else ok(message)
