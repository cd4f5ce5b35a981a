"""The servo on a Pi 4 or older: pulses by pigpiod, over a link that may come and go.

A countdown script inside pigpiod ends the pulses when fishd no longer writes, whatever ended it.
"""

import pigpio

from fishd.clock import Clock
from fishd.errors import ServoError
from fishd.hardware import pigpio_pulses
from fishd.hardware.calibration import ServoCalibration, calibrated
from fishd.hardware.pigpio_client import Client
from fishd.hardware.pigpio_link import PigpioLink
from fishd.hardware.pigpio_pulses import COUNT, OFF, armed
from fishd.hardware.pulses import pulse_width
from fishd.hardware.settings import ServoSettings


class PigpioServo:
    """A servo on pigpiod; write, release and close may be called from any thread."""

    calibration: ServoCalibration

    degraded: tuple[str, ...] = ()

    def __init__(
        self,
        settings: ServoSettings,
        calibration: ServoCalibration,
        clock: Clock,
        *,
        threaded: bool,
        tick: float = 0.05,
    ) -> None:
        """Connect within 2 s, or go on without and keep trying.

        threaded: True in real time. False connects in `write` and `release`, for virtual time, and
            does nothing here
        tick: period of the writes [s]
        Raises `ServoError` for a calibration whose neutral is no pulse for a servo.
        """
        self._settings = settings
        self._clock = clock
        self._tick = tick
        self._counts = pigpio_pulses.counts(settings.pigpio.countdown, tick)
        self.countdown = COUNT * self._counts
        self._script = -1
        self._energised = False
        self._armed = 0.0  # when the latest countdown that pigpiod has confirmed was sent
        self._closed = False
        self.recalibrate(calibration)
        self._link = PigpioLink(settings.pigpio, clock, self._prepare, threaded=threaded)

    def recalibrate(self, calibration: ServoCalibration) -> None:
        """Use another calibration from the next write on.

        Raises `ServoError`, and keeps the old one, if its neutral is no pulse for a servo.
        """
        settings = calibrated(self._settings, calibration)
        self._neutral = pulse_width(settings, 0.0)
        self._settings = settings
        self.calibration = calibration

    def write(self, angle: float) -> None:
        """Arm the countdown, and send an instruction angle [rad].

        An answer that comes late is no error: the servo keeps its angle for a tick. Raises
        `ServoError` at the third in a row, or before the countdown could end.
        """
        width = pulse_width(self._settings, angle)
        with self._link.session(forgives=self._has_time) as client:
            late = client.owed
            client.settle()
            now = self._clock.monotonic()
            if late and self._energised and now - self._armed > self.countdown:
                raise ConnectionError("it answered so late that the servo may be at rest by now")
            # First the countdown: whatever happens next, these pulses will have an end.
            countdown = armed(self._settings.gpio, self._counts, self._neutral)
            client.update_script(self._script, countdown)
            self._armed = now
            self._energised = True
            client.set_servo_pulsewidth(self._settings.gpio, round(width))

    def release(self) -> None:
        """Stop the pulses and disarm the countdown; may be called twice."""
        with self._link.session() as client:
            self._release(client)

    def close(self) -> None:
        """Release the servo, remove the script and disconnect; may be called twice.

        Raises `ServoError`, once all that could be done is done, if pulses may still be on.
        """
        if self._closed:
            return
        self._closed = True
        try:
            with self._link.session(last=True) as client:
                self._release(client)
                client.delete_script(self._script)
        except ServoError:
            if self._energised:
                raise
        finally:
            self._link.close()

    def counters(self) -> dict[str, int]:
        """How often the link was made again since start, and how many answers came late."""
        return {
            "servo_reconnects": self._link.reconnects,
            "servo_late_answers": self._link.late_answers,
        }

    def neutralise(self) -> bool:
        """Last resort, from another process than fishd: neutral for 0.3 s, then off.

        Ends this object's own link. The rest is as `pigpio_pulses.neutralise` says.
        """
        self._closed = True
        self._link.close()
        settings, sleep = self._settings, self._clock.sleep
        return pigpio_pulses.neutralise(settings.pigpio, settings.gpio, self._neutral, sleep)

    def _has_time(self) -> bool:
        """Whether the countdown leaves time for another tick."""
        silence = self._clock.monotonic() - self._armed
        return not self._energised or silence + self._tick < self.countdown

    def _release(self, client: Client) -> None:
        gpio = self._settings.gpio
        failure = None
        try:
            # Not disarmed but armed with OFF: if this alone arrives, it ends the pulses.
            client.update_script(self._script, armed(gpio, 1, OFF))
        except pigpio.error as error:
            failure = error
        client.set_servo_pulsewidth(gpio, OFF)
        self._energised = False
        if failure:
            raise failure

    def _prepare(self, client: Client) -> None:
        """Put a new connection in order: no pulses go on unless the loop writes again.

        The scripts of those before stay armed until that of this connection is. It ends pulses that
        the bytes of a lost connection, or of a killed fishd, still bring.
        """
        gpio, sleep = self._settings.gpio, self._clock.sleep
        former = pigpio_pulses.countdowns(client, gpio)
        count, width = self._counts, float(OFF)
        if not self._energised and pigpio_pulses.pulses_on(client, gpio, sleep):
            count, width = 1, self._neutral  # of a killed fishd: gently
        self._script = pigpio_pulses.install(client, gpio, count, width, sleep)
        if self._energised:
            client.set_servo_pulsewidth(gpio, OFF)
        pigpio_pulses.remove(client, former)
        self._energised = False
