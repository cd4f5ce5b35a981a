"""Pulses on a channel of the kernel's PWM: how they begin and end, for the servo and for whoever
releases it.

The hardware makes them, so they outlive their process. Needs nothing but the standard library.
"""

import os
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from fishd.core.errors import ServoError
from fishd.hardware.servo.pulses import REST
from fishd.hardware.servo.pwm_channel import Clock, Files, PwmChannel, Wires

PATIENCE = 2.0
"""How long udev may take to hand over the files of a new channel [s]; ticks do not wait for it."""
READ_BACK_S = 0.1
"""Time in which a program that drives the channel writes again [s]."""


def nanoseconds(width: float) -> int:
    """A pulse [µs] as the kernel counts it."""
    return round(1000.0 * width)


def begin(channel: PwmChannel, width: float, period: float) -> None:
    """Start pulses [µs], one in each period [s], from whatever state the channel was left in.

    A channel that nobody has used has a period of 0, and older kernels then refuse a duty cycle,
    even 0, and a polarity. A kernel that believes a channel to be on does nothing on enable 1, even
    where the hardware is off because the channel was unexported: it is switched off first.
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


def on(channel: PwmChannel) -> bool:
    """Whether there are pulses."""
    return bool(channel.read("enable") and channel.read("duty_cycle"))


def switch_off(channel: PwmChannel, period: float, sleep: Callable[[float], None]) -> None:
    """Switch the channel off, once the last pulse before a duty cycle of 0 has ended."""
    with suppress(ServoError):  # one that cannot be read may be on
        if not channel.read("enable"):
            return
    sleep(period)
    channel.write("enable", 0)


def neutralise(
    neutral: float, *, frequency: float, files: Files = os, clock: Clock = time, **wires: Any
) -> bool:
    """Send a servo that gets pulses to neutral [µs] and stop them; False where there are none.

    The last resort when fishd is dead. Should it be alive, its next write fails, because its pulses
    are off. Raises `ServoError` when a step fails; the pulses are stopped all the same, if they can
    be. A channel that was not exported is not left so.

    wires: those of `Wires`
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
    channel.open(PATIENCE)
    if not on(channel):
        return False
    try:
        if channel.inverted():  # what was a pulse was the gap between two
            begin(channel, neutral, period)
        else:
            channel.write("duty_cycle", nanoseconds(neutral))
        sleep(REST)
    finally:
        try:
            channel.write("duty_cycle", 0)
        finally:
            switch_off(channel, period, sleep)
    sleep(READ_BACK_S)
    if on(channel):
        raise ServoError(f"{channel.path}: has pulses again: another program drives it")
    return True
