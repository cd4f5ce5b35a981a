"""Emulated I2C bus with chips, with the duration and the failures of a real one.

The operations of drivers on its device file, see `linux_i2c`, result in `I2cBus.transfer`.
"""

import errno
import os
import threading
from collections.abc import Sequence
from typing import NamedTuple, Protocol

from fishd.core.clock import Clock
from fishd.virtual.pi.faults import TRANSFER_ERRORS, Faults

KERNEL_TIMEOUT = 1.0
"""Default time after which the kernel gives up on a hanging bus [s]."""


class Write(NamedTuple):
    """Bytes to a device; an empty message is a probe."""

    data: bytes


class Read(NamedTuple):
    """Request for a number of bytes from a device."""

    length: int


Message = Write | Read


class I2cDevice(Protocol):
    """Chip on the bus. Each method raises OSError EREMOTEIO where it does not acknowledge."""

    def write(self, data: bytes) -> None:
        """Receive bytes from the master."""

    def read(self, length: int) -> bytes:
        """Return `length` bytes."""


def kernel_error(number: int) -> OSError:
    """Return an error of the kernel; EREMOTEIO is a missing acknowledge."""
    return OSError(number, os.strerror(number))


class I2cBus:
    """Master and its chips; transfers from several threads wait for one another.

    A transfer takes the time of nine bits per byte, including addresses, of start and stop, and of
    the kernel. The chips receive the messages at the end of the transfer.
    """

    OVERHEAD = 50e-6
    """Time of the kernel in each transfer [s]."""
    WAY_BACK = 50e-6
    """Time of an answer on its way to another process [s]."""

    def __init__(self, clock: Clock, speed: float, faults: Faults) -> None:
        """`speed`: bit rate [bit/s]."""
        self.timeout = KERNEL_TIMEOUT
        """Time after which the kernel gives up on a hanging bus [s]."""
        self._clock = clock
        self._speed = speed
        self._faults = faults
        self._devices: dict[int, I2cDevice] = {}
        self._lock = threading.Lock()

    def attach(self, address: int, device: I2cDevice) -> None:
        """Attach a chip to the bus; raises ValueError if the address is taken."""
        if address in self._devices:
            raise ValueError(f"address {address:#04x} is taken by another chip on the bus")
        self._devices[address] = device

    def transfer(
        self, address: int, messages: Sequence[Message], asked: float | None = None
    ) -> list[bytes]:
        """Perform one transfer, and return the bytes of each `Read`.

        asked: time of the request of another process [s, on a clock that both share]; the time
            since then, and the way back, count as time on the bus

        Raises OSError as the kernel does: 121 no acknowledge, 110 (TimeoutError) after `timeout`,
        5 clock held too long, 16 bus owned, 11 (BlockingIOError) arbitration lost. A failed
        transfer may have reached the chip in part or in full.
        """
        with self._lock:
            error = self._faults.transfer_error()
            delivered = (
                messages[: self._count_delivered(error, len(messages))] if error else messages
            )
            duration = self.OVERHEAD + self._time_on_wire(delivered)
            if asked is not None and 0.0 <= (elapsed := self._clock.monotonic() - asked) < duration:
                duration -= elapsed + self.WAY_BACK
            self._clock.sleep(max(0.0, duration))
            replies = [self._deliver(address, message) for message in delivered]
            if error is None:
                return [reply for reply in replies if reply is not None]
            if error == "timeout":
                self._clock.sleep(self.timeout)
            raise kernel_error(TRANSFER_ERRORS[error])

    def _count_delivered(self, error: str | None, count: int) -> int:
        """Return the number of messages that reach the chip."""
        if error is None:
            return count
        if error == "bus-owned":
            return 0
        if error == "nack":  # The unacknowledged message did not arrive.
            return self._faults.random.randint(0, max(0, count - 1))
        return self._faults.random.randint(0, count)

    def _time_on_wire(self, messages: Sequence[Message]) -> float:
        bits = 1  # stop
        for message in messages:
            length = len(message.data) if isinstance(message, Write) else message.length
            bits += 1 + 9 * (1 + length)
        return bits / self._speed

    def _deliver(self, address: int, message: Message) -> bytes | None:
        if address not in self._devices:
            raise kernel_error(errno.EREMOTEIO)
        if isinstance(message, Read):
            return self._devices[address].read(message.length)
        self._devices[address].write(message.data)
        return None
