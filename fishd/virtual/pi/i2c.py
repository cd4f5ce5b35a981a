"""An I2C bus: carries transfers to the emulated chips, takes as long as a real one, and fails.

What drivers do with its device file, `linux_i2c`, ends in `I2cBus.transfer`.
"""

import errno
import os
import threading
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from fishd.core.clock import Clock
from fishd.virtual.pi.faults import TRANSFER_ERRORS, Faults

KERNEL_TIMEOUT = 1.0
"""How long the kernel waits for a hanging bus, until told otherwise [s]."""


class Write(NamedTuple):
    """Bytes to a device; none at all is a probe."""

    data: bytes


class Read(NamedTuple):
    """So many bytes from a device."""

    length: int


Message = Write | Read


class I2cDevice(Protocol):
    """A chip on the bus. Each method raises OSError EREMOTEIO to withhold the acknowledge."""

    def write(self, data: bytes) -> None:
        """Take what a master writes."""

    def read(self, length: int) -> bytes:
        """Give `length` bytes."""


def kernel_error(number: int) -> OSError:
    """An error as the kernel gives it; EREMOTEIO is a missing acknowledge."""
    return OSError(number, os.strerror(number))


class I2cBus:
    """One master and its chips; transfers from several threads queue.

    Lets time pass on its clock: nine bits per byte, addresses included, start and stop, and the
    kernel's own time. The chips see the messages at the end of the transfer.
    """

    OVERHEAD = 50e-6
    """Time that the kernel adds to each transfer [s]."""
    WAY_BACK = 50e-6
    """Time that an answer takes to reach another process [s]."""

    def __init__(self, clock: Clock, speed: float, faults: Faults) -> None:
        """`speed` in bit/s."""
        self.timeout = KERNEL_TIMEOUT
        """How long the kernel waits for a hanging bus [s]."""
        self._clock = clock
        self._speed = speed
        self._faults = faults
        self._devices: dict[int, I2cDevice] = {}
        self._lock = threading.Lock()

    def attach(self, address: int, device: I2cDevice) -> None:
        """Put a chip on the bus; ValueError if the address is taken."""
        if address in self._devices:
            raise ValueError(f"address {address:#04x} is taken by another chip on the bus")
        self._devices[address] = device

    def transfer(
        self, address: int, messages: Sequence[Message], asked: float | None = None
    ) -> list[bytes]:
        """Carry out one transfer; the bytes of each `Read`.

        asked: when another process asked for it [s, on a clock that both share]; what has passed
            since, and the way back, then counts as time on the bus

        Raises OSError as the kernel does: 121 no acknowledge, 110 (TimeoutError) after `timeout`,
        5 clock held too long, 16 bus owned, 11 (BlockingIOError) arbitration lost. A transfer that
        fails may have reached the chip in part or in full.
        """
        with self._lock:
            error = self._faults.transfer_error()
            reached = messages[: self._reach(error, len(messages))] if error else messages
            duration = self.OVERHEAD + self._time_on_wire(reached)
            if asked is not None and 0.0 <= (spent := self._clock.monotonic() - asked) < duration:
                duration -= spent + self.WAY_BACK
            self._clock.sleep(max(0.0, duration))
            replies = [self._carry_out(address, message) for message in reached]
            if error is None:
                return [reply for reply in replies if reply is not None]
            if error == "timeout":
                self._clock.sleep(self.timeout)
            raise kernel_error(TRANSFER_ERRORS[error])

    def _reach(self, error: str | None, count: int) -> int:
        """How many of the messages get through to the chip."""
        if error is None:
            return count
        if error == "bus-owned":
            return 0
        if error == "nack":  # The message that nobody acknowledged did not get through.
            return self._faults.random.randint(0, max(0, count - 1))
        return self._faults.random.randint(0, count)

    def _time_on_wire(self, messages: Sequence[Message]) -> float:
        bits = 1  # stop
        for message in messages:
            length = len(message.data) if isinstance(message, Write) else message.length
            bits += 1 + 9 * (1 + length)
        return bits / self._speed

    def _carry_out(self, address: int, message: Message) -> bytes | None:
        if address not in self._devices:
            raise kernel_error(errno.EREMOTEIO)
        if isinstance(message, Read):
            return self._devices[address].read(message.length)
        self._devices[address].write(message.data)
        return None
