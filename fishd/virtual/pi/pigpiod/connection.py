"""Connection of one client to the emulated pigpiod: decodes commands and sends replies."""

import contextlib
import math
import socket
import struct

from fishd.virtual.pi.pigpiod import errors
from fishd.virtual.pi.pigpiod.commands import NAMES, Commands
from fishd.virtual.pi.pigpiod.script import MAX_DELAY_MS

MAX_EXTENSION_BYTES = 65_535
"""Largest extension of a command; pigpiod drops a client that announces more [bytes]."""
_MILS = NAMES.index("MILS")
_HEADER = struct.Struct("<4I")
"""Header of a command: number, p1, p2, length of the extension; in a reply, the result is last."""


class Connection:
    """Connection that executes the commands of one client in their order."""

    def __init__(self, client: socket.socket, commands: Commands) -> None:
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = client
        self._commands = commands
        self._input = bytearray()
        self._late_reply = b""
        self.due = math.inf
        """End of a delay that the client has requested [s]."""

    def receive(self, time: float) -> bool:
        """Read and execute commands at a time [s]; return False if the client has disconnected."""
        try:
            data = self.socket.recv(MAX_EXTENSION_BYTES)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self._input += data
        return bool(data) and self._execute_input(time)

    def end_delay(self, time: float) -> bool:
        """Answer a finished delay and continue; return False if the client must be dropped."""
        self.due = math.inf
        self._send(self._late_reply)
        return self._execute_input(time)

    def hang_up(self) -> None:
        """Shut down the connection; the server then detects that it is closed."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)

    def _send(self, data: bytes) -> None:
        """Send data, or disconnect a client that does not read its replies."""
        try:
            if self.socket.send(data) == len(data):
                return
        except OSError:
            pass
        self.hang_up()

    def _execute_input(self, time: float) -> bool:
        while self.due == math.inf and len(self._input) >= _HEADER.size:
            number, p1, p2, length = _HEADER.unpack_from(self._input)
            if length > MAX_EXTENSION_BYTES:
                return False
            end = _HEADER.size + length
            if len(self._input) < end:
                break
            extension = bytes(self._input[_HEADER.size : end])
            del self._input[:end]
            self._answer(time, number, p1, p2, extension)
        # Drop a client that keeps sending while it should wait for its reply.
        return len(self._input) <= _HEADER.size + MAX_EXTENSION_BYTES

    def _answer(self, time: float, number: int, p1: int, p2: int, extension: bytes) -> None:
        extra_bytes = b""
        if number != _MILS:
            result, extra_bytes = self._commands.execute(time, number, p1, p2, extension)
        else:
            result = 0 if p1 <= MAX_DELAY_MS else errors.BAD_MILS_DELAY
        reply = _HEADER.pack(number, p1, p2, result & 0xFFFFFFFF) + extra_bytes
        if number == _MILS and p1 and result == 0:
            self.due, self._late_reply = time + p1 * 1e-3, reply
        else:
            self._send(reply)
