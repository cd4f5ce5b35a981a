"""ADS1115 through its Adafruit driver, with single-shot mode made safe and cheap."""

import os
from typing import Any

from adafruit_ads1x15 import ADS1115, AnalogIn, ads1x15

from fishd.core.clock import Clock

MAX_CONVERSION_PERIODS, CONVERSION_TIMEOUT_PERIODS = 1.1, 1.25
"""Longest time of a conversion, and time after which it has failed, as multiples of 1/data rate."""

_CONFIG, _HIGH_THRESHOLD = 1, 3
_IDLE_BIT = 0x8000
_WAKE_UP_S = 25e-6
"""Time that the chip needs before a conversion [s]."""
_GAINS = {6.144: 2 / 3, 4.096: 1, 2.048: 2, 1.024: 4, 0.512: 8, 0.256: 16}


class SingleShot(ADS1115):  # type: ignore[misc]
    """The Adafruit driver, changed to sleep while the chip converts and to wait with a timeout."""

    def __init__(
        self, bus: Any, address: int, full_scale: float, data_rate: int, clock: Clock
    ) -> None:
        """Find the chip on a bus and set it up; raise OSError if that fails.

        full_scale: range of the inputs, ± this [V]
        data_rate: number of conversions per second
        """
        self._clock = clock
        self.started = 0.0
        """Time at which the latest conversion began [s, monotonic]."""
        self._sleep = _WAKE_UP_S + MAX_CONVERSION_PERIODS / data_rate
        self._limit = CONVERSION_TIMEOUT_PERIODS / data_rate
        self._pointer = bytearray(1)
        self._word = bytearray(2)
        try:
            super().__init__(
                bus,
                gain=_GAINS[full_scale],
                data_rate=data_rate,
                # It has no effect, as the comparator is off, but makes every config of fishd
                # differ from that after a reset, so that a reset is detected.
                comparator_mode=ads1x15.Comp_Mode.WINDOW,
                address=address,
            )
        except ValueError as error:
            # The cause gets no name: its traceback refers to this frame, which would refer to it.
            number = getattr(error.__context__, "errno", None)
            if number is None:
                raise
            raise OSError(number, os.strerror(number)) from None

    def high_threshold(self) -> int:
        """Return the high threshold of the chip, of which the driver has set all bits but one."""
        return self._read_register(_HIGH_THRESHOLD)

    def input(self, channel: str) -> Any:
        """Return an input, such as `A0` or `A0-A1`; reading its `value` makes a conversion."""
        return AnalogIn(self, *(int(pin[1]) for pin in channel.split("-")))

    def check_idle(self) -> None:
        """Raise TimeoutError while a conversion is under way: a start would be ignored."""
        if not self._read_register(_CONFIG) & _IDLE_BIT:
            raise TimeoutError("the ADS1115 stays busy: switch its power off and on")

    def _read(self, pin: int) -> int:
        """Convert and return the code; raise OSError if it might not be that of `pin`."""
        clock = self._clock
        self._write_config(pin)
        settings = (self.buf[1] << 8 | self.buf[2]) & ~_IDLE_BIT
        started = clock.monotonic()
        self.started = started + _WAKE_UP_S
        clock.sleep(self._sleep)
        while True:
            now = clock.monotonic()
            config = self._read_register(_CONFIG, fast=True)
            if config & ~_IDLE_BIT != settings:
                raise OSError("the ADS1115 was reset while it converted: check its power")
            if config & _IDLE_BIT:
                break
            # A conversion that ends later was not started here.
            if now - started > self._limit:
                raise TimeoutError(
                    "the ADS1115 does not end its conversions: switch its power off and on"
                )
            clock.sleep(0.1 * self._limit)
        return int(self._conversion_value(self.get_last_result()))

    def _read_register(self, reg: int, fast: bool = False) -> int:
        """Read a register, or with `fast` the register that the pointer is at.

        The combined transfer of the Adafruit driver takes four times as long in the interpreter and
        leaves reference cycles: the garbage collector would have to collect 4000 per second.
        """
        with self.i2c_device as i2c:
            if not fast:
                self._pointer[0] = reg
                i2c.write(self._pointer)
            i2c.readinto(self._word)
        return self._word[0] << 8 | self._word[1]
