"""How the emulated pigpiod treats its connections, good and bad."""

import socket
import struct
from collections.abc import Iterator

import pytest
from pigpiod_client import GPIO, PigpiodBench, dispose, eventually, pigpiod_bench

from fishd.emulation.pigpiod.daemon import Pigpiod


@pytest.fixture
def bench() -> Iterator[PigpiodBench]:
    with pigpiod_bench() as bench:
        yield bench


def test_commands_may_arrive_in_any_pieces(bench: PigpiodBench) -> None:
    with socket.create_connection(("127.0.0.1", bench.daemon.port)) as link:
        commands = struct.pack("<4I", 8, GPIO, 1500, 0) + struct.pack("<5I", 86, GPIO, 50, 4, 75000)
        for byte in commands:
            link.sendall(bytes([byte]))
        replies = b""
        while len(replies) < 32:
            replies += link.recv(64)
    assert struct.unpack("<8I", replies) == (8, GPIO, 1500, 0, 86, GPIO, 50, 0)


@pytest.mark.parametrize("garbage", [b"\xff" * 16, b"GET / HTTP/1.1\r\n\r\n"])
def test_garbage_costs_its_sender_the_connection_and_nobody_else(
    bench: PigpiodBench, garbage: bytes
) -> None:
    with socket.create_connection(("127.0.0.1", bench.daemon.port)) as link:
        link.sendall(garbage)
        assert link.recv(64) == b""
    assert bench.pi.set_servo_pulsewidth(GPIO, 1500) == 0


def test_closing_ends_every_connection_and_the_thread(bench: PigpiodBench) -> None:
    with socket.create_connection(("127.0.0.1", bench.daemon.port)) as link:
        dispose(bench.pi)
        bench.daemon.close()
        bench.daemon.close()
        assert link.recv(64) == b""
    assert eventually(lambda: not bench.daemon._thread.is_alive())
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", bench.daemon.port))


def test_a_client_that_never_reads_its_replies_is_hung_up_on(bench: PigpiodBench) -> None:
    with socket.create_connection(("127.0.0.1", bench.daemon.port)) as link:
        many = struct.pack("<4I", 16, 0, 0, 0) * 5_000_000
        with pytest.raises(OSError, match=r"reset|[Bb]roken"):
            link.sendall(many)
        assert bench.pi.set_servo_pulsewidth(GPIO, 1500) == 0


def test_a_port_that_is_taken_is_an_error_at_once(bench: PigpiodBench) -> None:
    another = Pigpiod(bench.clock, bench.faults, bench.daemon.port)
    with pytest.raises(OSError, match="in use"):
        another.start()
    another.close()
