"""Countdown script inside pigpiod, which ends the pulses after their client has died.

The script survives the client: unless it is armed again in time, it moves the servo to neutral, and
half a second later it ends the pulses. The rule of this module and of the servo: at every instant,
either a running script is armed or pigpiod sends no pulses. A script armed with OFF ends them.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pigpio

from fishd.core.errors import ServoError
from fishd.hardware.servo.pigpio_client import (
    ANSWER_TIMEOUT_S,
    MAX_SCRIPTS,
    SCRIPT_PARAMETERS,
    UNKNOWN_SCRIPT,
    Client,
    MissingCommands,
    open_client,
)
from fishd.hardware.servo.pulses import NEUTRAL_TIME_S

OFF = 0
"""Pulse width that means no pulses."""

COUNT_S = 0.01
"""Time of one count of the script [s]."""

# p0: counts left, 0 is disarmed · p1: GPIO · p2: the pulse to end with, 0 for none · p9: SCRIPT_ID.
# After the hold, p0 shows whether the script was armed again in the meantime: then the pulses stay.
# OFF is not followed by a hold: a servo that is written to again is guarded at once. While
# disarmed, the script ends pulses in every count: a late command of a dead sender, which arrives
# after the countdown, has an effect for one count at most.
COUNTDOWN = (
    b"tag 0 mils 10 lda p0 cmp 0 jz 1 dcr p0 jnz 0 "
    b"s p1 p2 lda p2 cmp 0 jz 0 mils 500 lda p0 cmp 0 jnz 0 tag 1 s p1 0 jmp 0"
)

SCRIPT_ID = int.from_bytes(b"fish", "big")
"""Number that identifies fishd's scripts among those of other programs."""

_GUARD_COUNTS = 60
"""Countdown of the script of `neutralise`, longer than its pulses [counts]."""

_PWM_MODES = {12: 4, 13: 4, 18: 2, 19: 2}
"""Mode in which the PWM peripheral drives a pin, by GPIO."""
_READ_BACKS, _READ_BACK_S = 10, 0.1
"""Number of checks at the end for pulses, and time before each check [s]."""
_LEVEL_READS, _LEVEL_READ_S = 130, 4e-4
"""Number of reads of a pin's level, and time between them [s]; together they cover two frames."""

_NOTHING = 99
"""Number that no script has."""

Sleep = Callable[[float], None]


def check_commands(client: Client) -> None:
    """Raise `MissingCommands` unless pigpiod knows the newest command that a countdown needs."""
    if not knows_updates(client):
        raise MissingCommands(
            f"{client.place} is version {client.get_pigpio_version()}, too old: it does not know "
            "PROCU, which the countdown needs"
        )


def knows_updates(client: Client) -> bool:
    """Return whether pigpiod can update scripts; what is sent here has no effect."""
    result = pigpio._pigpio_command_ext(client.sl, pigpio._PI_CMD_PROCU, _NOTHING, 0, 0, [b""])
    return bool(pigpio.u2i(result) != pigpio.PI_UNKNOWN_COMMAND)


def countdown_counts(countdown: float, tick: float) -> int:
    """Return the counts of a countdown [s], which lasts three ticks [s] at least."""
    return math.ceil(round(max(countdown, 3.0 * tick) / COUNT_S, 6))


def armed_parameters(gpio: int, count: int, width: float) -> list[int]:
    """Return the script's first parameters, to send a pulse `width` [µs] after `count` counts."""
    return [count, gpio, round(width)]


def find_countdowns(client: Client, gpio: int, limit: float | None = None) -> list[int]:
    """Return the numbers of the scripts on this pin that earlier clients left behind.

    limit: time limit of each of the many commands [s]; without it they share the client's
    """
    numbers = []
    for script in range(MAX_SCRIPTS):
        if limit is not None:
            client.within(limit)
        _, parameters = client.script_status(script)
        if parameters and parameters[1] == gpio and parameters[-1] == SCRIPT_ID:
            numbers.append(script)
    return numbers


def install(client: Client, gpio: int, count: int, width: float, sleep: Sleep) -> int:
    """Store a countdown and run it, armed; return the number of the script."""
    script: int = client.store_script(COUNTDOWN)
    parameters = armed_parameters(gpio, count, width)
    parameters += [0] * (SCRIPT_PARAMETERS - 1 - len(parameters)) + [SCRIPT_ID]
    client.update_script(script, parameters)  # at once, so that other programs can identify it
    while client.script_status(script)[0] == pigpio.PI_SCRIPT_INITING:
        sleep(0.001)
    client.run_script(script, parameters)
    return script


def remove(client: Client, scripts: list[int]) -> None:
    """Delete countdowns that are no longer needed."""
    for script in scripts:
        client.within(ANSWER_TIMEOUT_S)  # a script in its hold at neutral ends the hold first
        with _ignore_missing_script():
            client.delete_script(script)


@contextmanager
def _ignore_missing_script() -> Iterator[None]:
    """Ignore the error that another program, such as another fishd, deleted a script."""
    try:
        yield
    except pigpio.error as error:
        if error.value != UNKNOWN_SCRIPT:
            raise


def pulses_on(client: Client, gpio: int, sleep: Sleep) -> bool:
    """Return whether there are pulses on the pin, of this pigpiod or of an earlier one.

    Pulses of the PWM peripheral outlive the pigpiod that started them, and the next pigpiod does
    not know of them: if the pin is in that mode, its level is read for two frames.
    """
    for read_width, no_pulses_error in (
        (client.get_servo_pulsewidth, pigpio.PI_NOT_SERVO_GPIO),
        (client.get_PWM_dutycycle, pigpio.PI_NOT_PWM_GPIO),
    ):
        try:
            if read_width(gpio):
                return True
        except pigpio.error as error:
            if error.value != pigpio.error_text(no_pulses_error):
                raise
    if client.get_mode(gpio) != _PWM_MODES.get(gpio):
        return False
    for _ in range(_LEVEL_READS):
        if client.read(gpio):
            return True
        sleep(_LEVEL_READ_S)
    return False


def neutralise(
    neutral: float, *, gpio: int, host: str, port: int, sleep: Sleep = time.sleep
) -> bool:
    """Send neutral [µs] for 0.3 s and end the pulses, from a process other than fishd.

    Return False, without motion, if the pin has no pulses. Deletes fishd's scripts, so that a fishd
    that is still alive gets a fault. If a step fails, it still tries to stop the pulses. Raises
    `ServoError` unless pigpiod reports at the end that the pulses have stopped.
    """
    try:
        with open_client(host, port) as client:
            energised = _neutralise(client, gpio, neutral, sleep)
            if energised:
                _check_off(client, gpio, sleep)
            return energised
    except BaseException as failure:
        try:
            with open_client(host, port) as client:
                client.set_servo_pulsewidth(gpio, OFF)
                remove(client, find_countdowns(client, gpio, ANSWER_TIMEOUT_S))
                _check_off(client, gpio, sleep)
        except ServoError:
            raise failure from None
        if isinstance(failure, ServoError):
            return True
        raise


def _neutralise(client: Client, gpio: int, neutral: float, sleep: Sleep) -> bool:
    has_scripts = knows_updates(client)
    scripts = find_countdowns(client, gpio, ANSWER_TIMEOUT_S) if has_scripts else []
    energised = _pulses_on(client, gpio, sleep)
    if energised:
        client.within(ANSWER_TIMEOUT_S)
        if has_scripts:
            # First a new script guards the pulses: this process may be killed too.
            guard = install(client, gpio, _GUARD_COUNTS, OFF, sleep)
            remove(client, scripts)
            scripts = [guard]
            client.within(ANSWER_TIMEOUT_S)
            with _ignore_missing_script():
                client.update_script(guard, armed_parameters(gpio, _GUARD_COUNTS, OFF))
        # This also takes the pin from the PWM peripheral.
        client.set_servo_pulsewidth(gpio, round(neutral))
        sleep(NEUTRAL_TIME_S)
        client.within(ANSWER_TIMEOUT_S)
        client.set_servo_pulsewidth(gpio, OFF)
    remove(client, scripts)
    return energised


def _check_off(client: Client, gpio: int, sleep: Sleep) -> None:
    """Read back that the pulses have stopped; raise `ServoError` if they return.

    Another program that drives the pin has time to write again. A fishd that reconnects may hold
    the servo at neutral for half a second.
    """
    for _ in range(_READ_BACKS):
        sleep(_READ_BACK_S)
        if not _pulses_on(client, gpio, sleep):
            return
    raise ServoError(f"GPIO {gpio} has pulses again: another program drives it")


def _pulses_on(client: Client, gpio: int, sleep: Sleep) -> bool:
    """Do as `pulses_on`, with a separate time limit for each read of the level."""

    def sleep_and_extend(seconds: float) -> None:
        sleep(seconds)
        client.within(ANSWER_TIMEOUT_S)

    client.within(ANSWER_TIMEOUT_S)
    return pulses_on(client, gpio, sleep_and_extend)
