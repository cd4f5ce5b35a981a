"""The ADS1115 through its Adafruit driver, with what makes single-shot mode safe and cheap."""

import os
from typing import TYPE_CHECKING, Any

from adafruit_ads1x15 import ADS1115, AnalogIn, ads1x15

from fishd.core.clock import Clock

if TYPE_CHECKING:
    from fishd.hardware.force_sensor.ads1115 import Ads1115Settings, Channel

SLOWEST, TOO_SLOW = 1.1, 1.25
"""Times of a conversion, as multiples of 1/data rate: the chip's tolerance, and what is wrong."""

_CONFIG = 1
_IDLE_BIT = 0x8000
_WAKE_UP = 25e-6  # of the chip, before a conversion [s]
_GAINS = {6.144: 2 / 3, 4.096: 1, 2.048: 2, 1.024: 4, 0.512: 8, 0.256: 16}


class SingleShot(ADS1115):  # type: ignore[misc]
    """The driver, except that it sleeps while the chip converts and does not wait for ever."""

    def __init__(self, bus: Any, settings: "Ads1115Settings", clock: Clock) -> None:
        """Find the chip on a bus and set it up; raises OSError."""
        self._clock = clock
        self._sleep = _WAKE_UP + SLOWEST / settings.data_rate
        self._limit = TOO_SLOW / settings.data_rate
        self._pointer = bytearray(1)
        self._word = bytearray(2)
        try:
            super().__init__(
                bus,
                gain=_GAINS[settings.full_scale],
                data_rate=settings.data_rate,
                # Without effect, as the comparator is off; but no config of ours is ever that of
                # a chip after a reset, so that a reset can be told.
                comparator_mode=ads1x15.Comp_Mode.WINDOW,
                address=settings.address,
            )
        except ValueError as error:
            # No name for the cause: its traceback would keep this frame, and this frame the cause.
            number = getattr(error.__context__, "errno", None)
            if number is None:
                raise
            raise OSError(number, os.strerror(number)) from None

    def input(self, channel: "Channel") -> Any:
        """One input, whose `value` is converted when it is asked for."""
        return AnalogIn(self, *(int(pin[1]) for pin in channel.split("-")))

    def check_idle(self) -> None:
        """Raise TimeoutError while a conversion is under way: a start would be ignored."""
        if not self._read_register(_CONFIG) & _IDLE_BIT:
            raise TimeoutError("the ADS1115 stays busy: switch its power off and on")

    def _read(self, pin: int) -> int:
        """Convert and return the code; raises OSError where it might not be that of `pin`."""
        clock = self._clock
        self._write_config(pin)
        settings = (self.buf[1] << 8 | self.buf[2]) & ~_IDLE_BIT
        started = clock.monotonic()
        clock.sleep(self._sleep)
        while True:
            asked = clock.monotonic()
            config = self._read_register(_CONFIG, fast=True)
            if config & ~_IDLE_BIT != settings:
                raise OSError("the ADS1115 was reset while it converted: check its power")
            if config & _IDLE_BIT:
                break
            # What ends later than this is no conversion that was started here.
            if asked - started > self._limit:
                raise TimeoutError(
                    "the ADS1115 does not end its conversions: switch its power off and on"
                )
            clock.sleep(0.1 * self._limit)
        return int(self._conversion_value(self.get_last_result()))

    def _read_register(self, reg: int, fast: bool = False) -> int:
        """Read a register, or with `fast` the one that the pointer is at.

        The driver's own way, one combined transfer, takes four times as long in the interpreter
        and leaves reference cycles behind, of which the garbage collector would have to make 4000
        per second disappear.
        """
        with self.i2c_device as i2c:
            if not fast:
                self._pointer[0] = reg
                i2c.write(self._pointer)
            i2c.readinto(self._word)
        return self._word[0] << 8 | self._word[1]
