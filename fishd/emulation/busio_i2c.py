"""An object like busio.I2C, for drivers that are given a bus instead of opening one."""

import threading
from collections.abc import Callable, Sequence

from fishd.emulation.i2c import Message, Read, Write


class BusioI2c:
    """The methods of busio.I2C over a transfer function; errors are its OSErrors."""

    def __init__(self, transfer: Callable[[int, Sequence[Message]], list[bytes]]) -> None:
        """`transfer`: (address, messages) to the bytes of each read."""
        self._transfer = transfer
        self._lock = threading.Lock()

    def try_lock(self) -> bool:
        """Take the bus if nobody has it; False at once otherwise."""
        return self._lock.acquire(blocking=False)

    def unlock(self) -> None:
        """Give the bus back; harmless if nobody has it."""
        if self._lock.locked():
            self._lock.release()

    def scan(self) -> list[int]:
        """The addresses that answer a write without data or a read of one byte."""
        return [address for address in range(0x08, 0x78) if self._answers(address)]

    def writeto(
        self, address: int, buffer: bytes | bytearray, *, start: int = 0, end: int | None = None
    ) -> None:
        """Write buffer[start:end]."""
        self._transfer(address, [Write(bytes(buffer[start:end]))])

    def readfrom_into(
        self, address: int, buffer: bytearray, *, start: int = 0, end: int | None = None
    ) -> None:
        """Fill buffer[start:end]."""
        window = memoryview(buffer)[start:end]
        window[:] = self._transfer(address, [Read(len(window))])[0]

    def writeto_then_readfrom(
        self,
        address: int,
        out_buffer: bytes | bytearray,
        in_buffer: bytearray,
        *,
        out_start: int = 0,
        out_end: int | None = None,
        in_start: int = 0,
        in_end: int | None = None,
    ) -> None:
        """Write and read in one transfer, without a stop between."""
        window = memoryview(in_buffer)[in_start:in_end]
        out = Write(bytes(out_buffer[out_start:out_end]))
        window[:] = self._transfer(address, [out, Read(len(window))])[0]

    def _answers(self, address: int) -> bool:
        for probe in (Write(b""), Read(1)):
            try:
                self._transfer(address, [probe])
            except OSError:
                continue
            return True
        return False
