"""The two ways in which pigpiod makes pulses, each with its countdown script.

The script runs inside pigpiod and so survives fishd: unless it is armed again in time, it moves the
servo to neutral, and half a second later it switches the pulses off.
"""

import math

import pigpio

from fishd.hardware.pigpio_client import Client
from fishd.hardware.settings import ServoSettings

OFF = 0.0
"""A pulse width that stands for no pulses."""

COUNT = 0.01
"""The script counts down once in so long [s]."""

# p0: counts left, 0 is disarmed · p1: GPIO · p2, p3: the pulse to end with · p9: MAGIC.
# After the hold p0 tells whether the script was armed again meanwhile: then the pulses stay.
COUNTDOWN = (
    "tag 0 mils 10 lda p0 cmp 0 jz 0 dcr p0 jnz 0 {neutral} mils 500 lda p0 cmp 0 jnz 0 {off} jmp 0"
)

MAGIC = int.from_bytes(b"fish", "big")
"""Tells fishd's scripts from those of others."""

PARAMETERS = 10
SCRIPTS = 32


def counts(countdown: float, tick: float) -> int:
    """What the script starts from: a countdown [s], or three ticks [s] of a slow loop."""
    return math.ceil(round(max(countdown, 3.0 * tick) / COUNT, 6))


class ServoPulses:
    """pigpiod's own servo pulses: 50 Hz on any pin, in steps of 5 µs, or 1 µs as configured."""

    script = COUNTDOWN.format(neutral="s p1 p2", off="s p1 0").encode()

    def __init__(self, settings: ServoSettings) -> None:
        self.gpio = settings.gpio

    def arguments(self, width: float) -> list[int]:
        """The script's parameters from p2 on, for a pulse `width` [µs]."""
        return [round(width)]

    def send(self, client: Client, width: float) -> None:
        """Set the pulse width [µs]; the running pulse ends as it was begun."""
        client.set_servo_pulsewidth(self.gpio, round(width))

    def on(self, client: Client) -> bool:
        """Whether there are pulses on the pin."""
        try:
            return bool(client.get_servo_pulsewidth(self.gpio) > 0)
        except pigpio.error as error:
            if error.value == pigpio.error_text(pigpio.PI_NOT_SERVO_GPIO):
                return False
            raise


class HardwarePwm:
    """The PWM peripheral: finer steps, up to 333 Hz, on GPIO 12, 13, 18 and 19."""

    script = COUNTDOWN.format(neutral="hp p1 p2 p3", off="hp p1 p2 0").encode()

    def __init__(self, settings: ServoSettings) -> None:
        self.gpio = settings.gpio
        self._frequency = round(settings.frequency)

    def arguments(self, width: float) -> list[int]:
        """The script's parameters from p2 on: frequency [Hz] and duty [1e-6]."""
        return [self._frequency, round(width * self._frequency)]

    def send(self, client: Client, width: float) -> None:
        """Set the pulse width [µs].

        Pulses are ended by a duty of 0 at the same frequency: a frequency of 0 would stop the
        peripheral in mid-pulse.
        """
        client.hardware_PWM(self.gpio, *self.arguments(width))

    def on(self, client: Client) -> bool:
        """Whether there are pulses on the pin."""
        try:
            return bool(client.get_PWM_dutycycle(self.gpio) > 0)
        except pigpio.error as error:
            if error.value == pigpio.error_text(pigpio.PI_NOT_PWM_GPIO):
                return False
            raise
