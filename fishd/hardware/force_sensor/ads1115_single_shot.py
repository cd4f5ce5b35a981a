"""The ADS1115 through its Adafruit driver, with what makes single-shot mode safe and cheap.

The sampler imports this only when it is made: the driver is no part of fishd's core.
"""

import errno
import logging
import os
from typing import Any

from adafruit_ads1x15 import ADS1115, AnalogIn, ads1x15
from adafruit_extended_bus import ExtendedI2C
from Adafruit_PureIO import smbus

from fishd.clock import Clock
from fishd.hardware.settings import Channel, ForceSensorSettings

log = logging.getLogger(__name__)

SLOWEST, TOO_SLOW = 1.1, 1.25
"""Times of a conversion, as multiples of 1/data rate: the chip's tolerance, and what is wrong."""

_CONFIG = 1
_IDLE_BIT = 0x8000
_WAKE_UP = 25e-6  # of the chip, before a conversion [s]
_GAINS = {6.144: 2 / 3, 4.096: 1, 2.048: 2, 1.024: 4, 0.512: 8, 0.256: 16}
_I2C_TIMEOUT = 0x0702
_TIMEOUT = 2  # [10 ms]; the kernel's own is 1 s


def open_bus(number: int) -> Any:
    """Open /dev/i2c-`number`; raises OSError."""
    try:
        bus = ExtendedI2C(number, frequency=None)
    except (ValueError, RuntimeError):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)) from None
    driver = bus._i2c._i2c_bus
    smbus.ioctl(driver._device.fileno(), _I2C_TIMEOUT, _TIMEOUT)
    driver._device = _StrictFile(driver._device)
    return bus


def close_bus(bus: Any) -> None:
    """Close it now; the library would leave that to the garbage collector. Raises no OSError."""
    driver = bus._i2c._i2c_bus
    try:
        driver.close()
    except OSError as error:  # Linux has closed it all the same
        log.warning("closing an I2C bus failed: %s", error)
        driver._device = None  # else it would be closed once more
    bus.deinit()


class _StrictFile:
    """A device file on which a lost transfer is an error.

    A raw file of Python returns None for EAGAIN, and the driver takes that for success.
    """

    def __init__(self, file: Any) -> None:
        self._file = file
        self.fileno = file.fileno
        self.close = file.close

    def read(self, length: int) -> bytes:
        content: bytes | None = self._file.read(length)
        if content is None:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return content

    def write(self, data: bytes) -> None:
        if self._file.write(data) is None:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))


class SingleShot(ADS1115):  # type: ignore[misc]
    """The driver, except that it sleeps while the chip converts and does not wait for ever."""

    def __init__(self, bus: Any, settings: ForceSensorSettings, clock: Clock) -> None:
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

    def input(self, channel: Channel) -> Any:
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
