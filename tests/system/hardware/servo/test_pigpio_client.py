"""The client of pigpiod with servers that answer wrongly, and a client that cannot start."""

import contextlib
import socket
import struct
import threading
from types import SimpleNamespace
from typing import Any

import pytest
from rigs.pigpio_rig import Bench
from rigs.processes import PATIENCE

from fishd.core.errors import ServoError
from fishd.hardware.servo import pigpio_link
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.servo.pigpio_client import Client, open_client


class Server:
    """Pigpiod that says its version, gives a prepared answer, and then ends or is silent."""

    def __init__(self, answer: bytes, *, dies: bool) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.settings = PigpioSettings(port=self._listener.getsockname()[1])
        self._answer, self._dies = answer, dies
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        connection, _ = self._listener.accept()
        with connection:
            connection.recv(16)
            connection.sendall(VERSION)
            connection.recv(16)
            connection.sendall(self._answer)
            if not self._dies:
                self._done.wait(10.0)

    def close(self) -> None:
        self._done.set()
        self._thread.join(PATIENCE)
        self._listener.close()


VERSION = struct.pack("<IIII", 26, 0, 0, 79)
HEADER = struct.pack("<IIII", 45, 0, 0, 44)


@pytest.mark.parametrize(
    ("answer", "dies", "message"),
    [
        (HEADER, True, "it closed the connection"),
        (HEADER, False, "no answer within 200 ms"),
        (HEADER[:9], True, "it closed the connection in the middle of an answer"),
        (b"", True, "it closed the connection"),
    ],
)
def test_an_answer_that_breaks_off_is_an_error(answer: bytes, dies: bool, message: str) -> None:
    server = Server(answer, dies=dies)
    try:
        host, port = server.settings.host, server.settings.port
        limit = PATIENCE if dies else 0.2
        with pytest.raises(ServoError, match=message), open_client(host, port, limit) as client:
            client.script_status(0)
    finally:
        server.close()


def test_a_host_that_is_none_is_one_line_too() -> None:
    problem = r"^pigpiod at a..b:8888: [^\n]+$"
    with pytest.raises(ServoError, match=problem), open_client("a..b", 8888):
        pass


def test_the_thread_outlives_an_error_that_nobody_thought_of(bench: Bench) -> None:
    attempts: list[Client] = []

    def prepare(client: Client) -> None:
        attempts.append(client)
        if len(attempts) == 1:
            raise IndexError("out of range")

    link = bench.link(prepare)
    assert link._connected.wait(PATIENCE)
    with contextlib.closing(link), link.session(last=True) as client:
        assert client is attempts[1]
        attempts[0].within(PATIENCE)
        with pytest.raises(OSError, match="Bad file descriptor"):
            attempts[0].get_pigpio_version()


def test_a_link_that_is_closed_while_it_connects_asks_for_nothing_more(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    connected, go = threading.Event(), threading.Event()
    asked: list[Client] = []

    class Held(Client):
        """Client that has a connection, but is not yet known to the link."""

        def __init__(self, *given: Any) -> None:
            super().__init__(*given)
            connected.set()
            go.wait(PATIENCE)

        def get_pigpio_version(self) -> int:
            asked.append(self)
            return 79

    monkeypatch.setattr(pigpio_link, "Client", Held)
    monkeypatch.setattr(pigpio_link, "START_TIMEOUT_S", 0.0)
    link = bench.link(asked.append)
    thread = link._thread
    assert connected.wait(PATIENCE)

    def join(limit: float) -> None:
        go.set()  # close has done all that it does before it waits
        thread.join(PATIENCE)

    monkeypatch.setattr(link, "_thread", SimpleNamespace(join=join))
    link.close()
    assert not thread.is_alive()
    assert asked == []
