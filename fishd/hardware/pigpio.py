"""The servo on a Pi 4 or older: pulses by pigpiod, over a link that may come and go.

A countdown script inside pigpiod ends the pulses when fishd no longer writes, whatever ended it.
"""

from contextlib import suppress

import pigpio

from fishd.clock import Clock
from fishd.errors import ServoError
from fishd.hardware.calibration import ServoCalibration, calibrated
from fishd.hardware.pigpio_client import ANSWER, Client, opened
from fishd.hardware.pigpio_link import PigpioLink
from fishd.hardware.pigpio_pulses import (
    COUNT,
    MAGIC,
    OFF,
    PARAMETERS,
    SCRIPTS,
    HardwarePwm,
    ServoPulses,
    counts,
)
from fishd.hardware.pulses import REST, pulse_width
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
        self._counts = counts(settings.pigpio.countdown, tick)
        self.countdown = COUNT * self._counts
        self._pulses = (
            HardwarePwm(settings) if settings.pigpio.hardware_pwm else ServoPulses(settings)
        )
        self._script = -1
        self._energised = False
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
        """Send an instruction angle [rad], and arm the countdown."""
        width = pulse_width(self._settings, angle)
        with self._link.session() as client:
            # First the countdown: whatever happens next, these pulses will have an end.
            client.update_script(self._script, self._countdown(self._counts, self._neutral))
            self._energised = True
            self._pulses.send(client, width)

    def release(self) -> None:
        """Disarm the countdown and stop the pulses; may be called twice."""
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
        """How often the link was made again since start."""
        return {"servo_reconnects": self._link.reconnects}

    def neutralise(self) -> bool:
        """Last resort, from another process than fishd: neutral for 0.3 s, then off.

        False if there are no pulses: then nothing moves. Removes fishd's scripts, so that a fishd
        that still lives gets a fault. Ends this object's own link. Raises `ServoError` when a step
        fails; the pulses are stopped all the same, if they can be.
        """
        self._closed = True
        self._link.close()
        try:
            return self._neutralise()
        except BaseException:
            # The countdowns may be disarmed by now: nothing else would end the pulses.
            with suppress(ServoError), opened(self._settings.pigpio) as client:
                self._pulses.send(client, OFF)
                self._delete(client, self._disarm_leftovers(client))
            raise

    def _neutralise(self) -> bool:
        with opened(self._settings.pigpio) as client:
            leftovers = self._disarm_leftovers(client)
            energised = self._pulses.on(client)
            if energised:
                self._pulses.send(client, self._neutral)
                self._clock.sleep(REST)
                client.within(ANSWER)
                self._pulses.send(client, OFF)
            self._delete(client, leftovers)
        return energised

    def _countdown(self, count: int, width: float) -> list[int]:
        return [count, self._pulses.gpio, *self._pulses.arguments(width)]

    def _release(self, client: Client) -> None:
        # Without a pulse in it: a count that the script is just writing back cannot energise.
        client.update_script(self._script, self._countdown(0, OFF))
        self._pulses.send(client, OFF)
        self._energised = False

    def _disarm_leftovers(self, client: Client) -> list[int]:
        """The scripts on this pin that an earlier connection or a killed fishd left behind."""
        leftovers = []
        for script in range(SCRIPTS):
            _, parameters = client.script_status(script)
            if parameters and parameters[1] == self._pulses.gpio and parameters[-1] == MAGIC:
                client.update_script(script, self._countdown(0, OFF))
                leftovers.append(script)
        return leftovers

    @staticmethod
    def _delete(client: Client, scripts: list[int]) -> None:
        for script in scripts:
            client.delete_script(script)

    def _prepare(self, client: Client) -> None:
        """Put a new connection in order: no pulses go on unless the loop writes again."""
        leftovers = self._disarm_leftovers(client)
        countdown = self._countdown(0, OFF)
        if self._energised:
            self._pulses.send(client, OFF)
            # And once more from the script: the lost connection may still hold a pulse.
            countdown = self._countdown(self._counts, OFF)
        elif leftovers and self._pulses.on(client):
            countdown = self._countdown(1, self._neutral)
        self._delete(client, leftovers)
        self._script = client.store_script(self._pulses.script)
        while client.script_status(self._script)[0] == pigpio.PI_SCRIPT_INITING:
            self._clock.sleep(0.001)
        padding = [0] * (PARAMETERS - 1 - len(countdown))
        client.run_script(self._script, [*countdown, *padding, MAGIC])
        self._energised = False
