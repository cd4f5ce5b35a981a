"""One client's connection to the emulated pigpiod: cuts the bytes into commands, sends replies."""

import contextlib
import math
import socket
import struct

from fishd.virtual.pi.pigpiod import errors
from fishd.virtual.pi.pigpiod.commands import NAMES, Commands
from fishd.virtual.pi.pigpiod.script import LONGEST_DELAY

LARGEST_EXTENSION = 65_535
"""pigpiod hangs up on a client that announces more than this [byte]."""
_MILS = NAMES.index("MILS")
_HEADER = struct.Struct("<4I")
"""Of a command: number, p1, p2, length of the extension; of a reply, with the result at the end."""


class Connection:
    """Carries out what one client asks, one command after the other."""

    def __init__(self, client: socket.socket, commands: Commands) -> None:
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = client
        self._commands = commands
        self._input = bytearray()
        self._late_reply = b""
        self.due = math.inf
        """When a delay that the client asked for is over [s]."""

    def receive(self, time: float) -> bool:
        """Read what has arrived and carry it out at this time [s]; False: the client is gone."""
        try:
            data = self.socket.recv(LARGEST_EXTENSION)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self._input += data
        return bool(data) and self._carry_out(time)

    def end_delay(self, time: float) -> bool:
        """Answer the delay that is over, and go on; False: the client is to be dropped."""
        self.due = math.inf
        self._send(self._late_reply)
        return self._carry_out(time)

    def hang_up(self) -> None:
        """Let the client see the end; the server then finds the connection closed."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)

    def _send(self, data: bytes) -> None:
        """Send, or hang up on a client that has not read what it was sent before."""
        try:
            if self.socket.send(data) == len(data):
                return
        except OSError:
            pass
        self.hang_up()

    def _carry_out(self, time: float) -> bool:
        while self.due == math.inf and len(self._input) >= _HEADER.size:
            number, p1, p2, length = _HEADER.unpack_from(self._input)
            if length > LARGEST_EXTENSION:
                return False
            end = _HEADER.size + length
            if len(self._input) < end:
                break
            extension = bytes(self._input[_HEADER.size : end])
            del self._input[:end]
            self._answer(time, number, p1, p2, extension)
        # A client that sends on and on while it should wait for its reply is no client.
        return len(self._input) <= _HEADER.size + LARGEST_EXTENSION

    def _answer(self, time: float, number: int, p1: int, p2: int, extension: bytes) -> None:
        following = b""
        if number != _MILS:
            result, following = self._commands.execute(time, number, p1, p2, extension)
        else:
            result = 0 if p1 <= LONGEST_DELAY else errors.BAD_MILS_DELAY
        reply = _HEADER.pack(number, p1, p2, result & 0xFFFFFFFF) + following
        if number == _MILS and p1 and result == 0:
            self.due, self._late_reply = time + p1 * 1e-3, reply
        else:
            self._send(reply)
