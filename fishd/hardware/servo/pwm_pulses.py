"""Start and end of pulses on a channel of the kernel's PWM, for the servo and its release.

The hardware makes the pulses, so they outlive their process. This module needs only the standard
library.
"""

import os
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from fishd.core.errors import ServoError
from fishd.hardware.servo.pulses import NEUTRAL_TIME_S
from fishd.hardware.servo.pwm_channel import Clock, Files, PwmChannel, Wires

UDEV_TIMEOUT_S = 2.0
"""Longest wait for udev to make a new channel's files writable [s]; ticks do not wait for it."""
READ_BACK_S = 0.1
"""Time within which another program that drives the channel writes again [s]."""


def nanoseconds(width: float) -> int:
    """Return the width of a pulse [µs] in nanoseconds."""
    return round(1000.0 * width)


def start_pulses(channel: PwmChannel, width: float, period: float) -> None:
    """Start pulses [µs], one in each period [s], from any state of the channel.

    An unused channel has a period of 0, and older kernels then refuse a duty cycle, even 0, and a
    polarity. A kernel that has recorded a channel as on ignores enable 1, even if the hardware is
    off because the channel was unexported: so the channel is switched off first.
    """
    if channel.read("enable"):
        channel.write("enable", 0)
    if channel.read("duty_cycle"):
        channel.write("duty_cycle", 0)
    channel.write("period", round(1e9 * period))
    if channel.inverted():
        channel.make_normal()
    channel.write("duty_cycle", nanoseconds(width))
    channel.write("enable", 1)


def has_pulses(channel: PwmChannel) -> bool:
    """Return whether there are pulses."""
    return bool(channel.read("enable") and channel.read("duty_cycle"))


def switch_off(channel: PwmChannel, period: float, sleep: Callable[[float], None]) -> None:
    """Switch the channel off, once the last pulse before a duty cycle of 0 has ended."""
    with suppress(ServoError):  # a channel that cannot be read may be on
        if not channel.read("enable"):
            return
    sleep(period)
    channel.write("enable", 0)


def neutralise(
    neutral: float, *, frequency: float, files: Files = os, clock: Clock = time, **wires: Any
) -> bool:
    """Send neutral [µs] for 0.3 s and end the pulses; return False if there are none.

    For the case that fishd is dead; the next write of a fishd that is alive fails, because its
    pulses are off. If a step fails, it still tries to stop the pulses, and raises `ServoError`. A
    channel that was not exported is unexported again.

    wires: fields of `Wires`
    """
    channel = PwmChannel(Wires(**wires), clock, files)
    try:
        return _neutralise(channel, neutral, 1.0 / frequency, clock.sleep)
    finally:
        channel.close()
        if channel.exported:
            channel.unexport()


def _neutralise(
    channel: PwmChannel, neutral: float, period: float, sleep: Callable[[float], None]
) -> bool:
    channel.open(UDEV_TIMEOUT_S)
    if not has_pulses(channel):
        return False
    try:
        if channel.inverted():  # a duty cycle would be the gap between two pulses
            start_pulses(channel, neutral, period)
        else:
            channel.write("duty_cycle", nanoseconds(neutral))
        sleep(NEUTRAL_TIME_S)
    finally:
        try:
            channel.write("duty_cycle", 0)
        finally:
            switch_off(channel, period, sleep)
    sleep(READ_BACK_S)
    if has_pulses(channel):
        raise ServoError(f"{channel.path}: has pulses again: another program drives it")
    return True
