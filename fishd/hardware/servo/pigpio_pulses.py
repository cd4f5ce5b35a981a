"""What keeps pigpiod's pulses from outliving whoever asked for them: a countdown inside of it.

The script survives the client: unless it is armed again in time, it moves the servo to neutral, and
half a second later it ends the pulses. The rule of this module and of the servo: whatever instant a
client dies at, a running script is armed, or there are no pulses. Armed with OFF, it ends them.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pigpio

from fishd.core.errors import ServoError
from fishd.hardware.servo.pigpio_client import (
    ANSWER,
    PARAMETERS,
    SCRIPTS,
    UNKNOWN_SCRIPT,
    Client,
    opened,
)
from fishd.hardware.servo.pulses import REST

OFF = 0
"""A pulse width that stands for no pulses."""

COUNT = 0.01
"""The script counts down once in so long [s]."""

# p0: counts left, 0 is disarmed · p1: GPIO · p2: the pulse to end with, 0 for none · p9: MAGIC.
# After the hold p0 tells whether the script was armed again meanwhile: then the pulses stay. There
# is no hold after OFF, so that a servo that is written to again is under guard at once. While it is
# disarmed it ends pulses again and again: a command that was under way when its sender died, and
# arrives after the countdown, has no effect for longer than a count.
COUNTDOWN = (
    b"tag 0 mils 10 lda p0 cmp 0 jz 1 dcr p0 jnz 0 "
    b"s p1 p2 lda p2 cmp 0 jz 0 mils 500 lda p0 cmp 0 jnz 0 tag 1 s p1 0 jmp 0"
)

MAGIC = int.from_bytes(b"fish", "big")
"""Tells fishd's scripts from those of others."""

_GUARD = 60
"""What a last resort arms its own script with: longer than the pulses take [counts]."""

_PWM_MODES = {12: 4, 13: 4, 18: 2, 19: 2}
"""GPIO → the mode in which the PWM peripheral drives it."""
_READ_BACKS, _READ_BACK_S = 10, 0.1
"""How often it is read back at the end whether there are pulses, and the time before each [s]."""
_LOOKS, _LOOK = 130, 4e-4
"""How often a pin's level is looked at, and how long is waited between [s]: two frames, densely."""

Sleep = Callable[[float], None]


def counts(countdown: float, tick: float) -> int:
    """What the script starts from: a countdown [s], or three ticks [s] of a slow loop."""
    return math.ceil(round(max(countdown, 3.0 * tick) / COUNT, 6))


def armed(gpio: int, count: int, width: float) -> list[int]:
    """The script's first parameters, to end with a pulse `width` [µs] after so many counts."""
    return [count, gpio, round(width)]


def countdowns(client: Client, gpio: int, limit: float | None = None) -> list[int]:
    """The scripts on this pin that an earlier connection or a killed fishd left behind.

    limit: of each of its many commands [s]; without it all of them share that of the client
    """
    found = []
    for script in range(SCRIPTS):
        if limit is not None:
            client.within(limit)
        _, parameters = client.script_status(script)
        if parameters and parameters[1] == gpio and parameters[-1] == MAGIC:
            found.append(script)
    return found


def install(client: Client, gpio: int, count: int, width: float, sleep: Sleep) -> int:
    """Store a countdown and run it, armed; the number of the script."""
    script: int = client.store_script(COUNTDOWN)
    parameters = armed(gpio, count, width)
    parameters += [0] * (PARAMETERS - 1 - len(parameters)) + [MAGIC]
    client.update_script(script, parameters)  # at once: nobody finds one without its name
    while client.script_status(script)[0] == pigpio.PI_SCRIPT_INITING:
        sleep(0.001)
    client.run_script(script, parameters)
    return script


def remove(client: Client, scripts: list[int]) -> None:
    """Delete countdowns, which must not be needed any more."""
    for script in scripts:
        client.within(ANSWER)  # one that holds the servo at neutral ends its hold first
        with _may_be_gone():
            client.delete_script(script)


@contextmanager
def _may_be_gone() -> Iterator[None]:
    """Permit that another program, such as a fishd that connects again, has deleted a script."""
    try:
        yield
    except pigpio.error as error:
        if error.value != UNKNOWN_SCRIPT:
            raise


def pulses_on(client: Client, gpio: int, sleep: Sleep) -> bool:
    """Whether there are pulses on the pin, of this pigpiod or of one before it.

    Those of the PWM peripheral outlive the pigpiod that began them, and the next one knows nothing
    of them: where the pin is in that mode, its level is watched for two frames.
    """
    for asked, otherwise in (
        (client.get_servo_pulsewidth, pigpio.PI_NOT_SERVO_GPIO),
        (client.get_PWM_dutycycle, pigpio.PI_NOT_PWM_GPIO),
    ):
        try:
            if asked(gpio):
                return True
        except pigpio.error as error:
            if error.value != pigpio.error_text(otherwise):
                raise
    if client.get_mode(gpio) != _PWM_MODES.get(gpio):
        return False
    for _ in range(_LOOKS):
        if client.read(gpio):
            return True
        sleep(_LOOK)
    return False


def neutralise(
    neutral: float, *, gpio: int, host: str, port: int, sleep: Sleep = time.sleep
) -> bool:
    """Last resort, from another process than fishd: neutral [µs] for 0.3 s, then off.

    False if there are no pulses: then nothing moves. Removes fishd's scripts, so that a fishd that
    still lives gets a fault. Raises `ServoError` unless pigpiod says at the end that there are no
    pulses. When a step fails, the pulses are stopped all the same, if they can be.
    """
    try:
        with opened(host, port) as client:
            energised = _neutralise(client, gpio, neutral, sleep)
            if energised:
                _check_off(client, gpio, sleep)
            return energised
    except BaseException as failure:
        try:
            with opened(host, port) as client:
                client.set_servo_pulsewidth(gpio, OFF)
                remove(client, countdowns(client, gpio, ANSWER))
                _check_off(client, gpio, sleep)
        except ServoError:
            raise failure from None
        if isinstance(failure, ServoError):
            return True
        raise


def _neutralise(client: Client, gpio: int, neutral: float, sleep: Sleep) -> bool:
    scripts = countdowns(client, gpio, ANSWER)
    energised = _pulses_on(client, gpio, sleep)
    if energised:
        client.within(ANSWER)
        # First a script of its own: this process may be killed, too.
        guard = install(client, gpio, _GUARD, OFF, sleep)
        remove(client, scripts)
        scripts = [guard]
        client.within(ANSWER)
        with _may_be_gone():
            client.update_script(guard, armed(gpio, _GUARD, OFF))
        # This takes the pin from the PWM peripheral as well.
        client.set_servo_pulsewidth(gpio, round(neutral))
        sleep(REST)
        client.within(ANSWER)
        client.set_servo_pulsewidth(gpio, OFF)
    remove(client, scripts)
    return energised


def _check_off(client: Client, gpio: int, sleep: Sleep) -> None:
    """Read back that there are no pulses; raises `ServoError`.

    A program that drives the pin has a tick in which to write again. A fishd that connects again
    may hold the servo at neutral for half a second.
    """
    for _ in range(_READ_BACKS):
        sleep(_READ_BACK_S)
        if not _pulses_on(client, gpio, sleep):
            return
    raise ServoError(f"GPIO {gpio} has pulses again: another program drives it")


def _pulses_on(client: Client, gpio: int, sleep: Sleep) -> bool:
    """Do as `pulses_on`, where each of many looks has its own time."""

    def look(seconds: float) -> None:
        sleep(seconds)
        client.within(ANSWER)

    client.within(ANSWER)
    return pulses_on(client, gpio, look)
