"""Edges of pins as pigpiod reports them, with its own times: a second look at pulses."""

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import NamedTuple

import pigpio

from fishd.hardware.servo.pigpio_client import ANSWER_TIMEOUT_S, Client, open_client

REPORT_DELAY_S = 0.1
"""Time within which pigpiod reports an edge [s]."""
_COMMAND, _REPORT = struct.Struct("<4I"), struct.Struct("<HHII")


class Edge(NamedTuple):
    """Change of the level of a pin."""

    time: float
    """[s], on the clock of `EdgeReader.now`"""
    level: int


class EdgeReader:
    """Reports of the edges of some pins, for at most an hour: their ticks of 1 µs have 32 bits."""

    def __init__(self, client: Client, reports: socket.socket, gpios: list[int]) -> None:
        """
        client: connection for commands
        reports: another connection to the same pigpiod, which receives the reports
        """
        self._client, self._reports, self._gpios = client, reports, gpios
        self._received = b""
        reports.sendall(_COMMAND.pack(pigpio._PI_CMD_NOIB, 0, 0, 0))
        answer = reports.recv(_COMMAND.size, socket.MSG_WAITALL)
        reports.setblocking(False)
        handle = _COMMAND.unpack(answer)[3]
        client.within(ANSWER_TIMEOUT_S)
        self._start = int(client.get_current_tick())
        self._levels = int(client.read_bank_1())
        mask = sum(1 << gpio for gpio in gpios)
        pigpio._u2i(pigpio._pigpio_command(client.sl, pigpio._PI_CMD_NB, handle, mask))

    def now(self) -> float:
        """Return the time since the start, on the clock of the reports [s]."""
        self._client.within(ANSWER_TIMEOUT_S)
        return self._seconds(int(self._client.get_current_tick()))

    def take(self) -> dict[int, list[Edge]]:
        """Return the edges of each pin since the previous call."""
        time.sleep(REPORT_DELAY_S)
        edges: dict[int, list[Edge]] = {gpio: [] for gpio in self._gpios}
        self._receive()
        whole = len(self._received) // _REPORT.size * _REPORT.size
        for _, flags, tick, levels in _REPORT.iter_unpack(self._received[:whole]):
            if flags:  # a sign of life, once a minute
                continue
            changed, self._levels = self._levels ^ levels, levels
            for gpio in self._gpios:
                if changed >> gpio & 1:
                    edges[gpio].append(Edge(self._seconds(tick), levels >> gpio & 1))
        self._received = self._received[whole:]
        return edges

    def _receive(self) -> None:
        try:
            while data := self._reports.recv(65536):
                self._received += data
        except BlockingIOError:
            return
        raise ConnectionResetError("it closed the connection of its reports")

    def _seconds(self, tick: int) -> float:
        return (tick - self._start & 0xFFFFFFFF) * 1e-6


@contextmanager
def open_edges(host: str, port: int, gpios: list[int]) -> Iterator[EdgeReader]:
    """Return the edges of pins from now on; raise `ServoError` for every error in the context."""
    with (
        open_client(host, port) as client,
        closing(socket.create_connection((host, port), ANSWER_TIMEOUT_S)) as reports,
    ):
        yield EdgeReader(client, reports, gpios)
