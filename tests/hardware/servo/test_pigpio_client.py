"""The client's time limits and errors, against servers that answer badly."""

import socket
import struct
import threading

import pytest
from rigs.processes import PATIENCE

from fishd.core.errors import ServoError
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.servo.pigpio_client import opened


class Server:
    """A pigpiod that gives one prepared answer and then dies, or goes silent."""

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
            connection.sendall(self._answer)
            if not self._dies:
                self._done.wait(10.0)

    def close(self) -> None:
        self._done.set()
        self._thread.join(PATIENCE)
        self._listener.close()


HEADER = struct.pack("<IIII", 45, 0, 0, 44)


@pytest.mark.parametrize(
    ("answer", "dies", "message"),
    [
        (HEADER, True, "it closed the connection"),
        (HEADER, False, "no answer within 200 ms"),
        (HEADER + bytes(11), True, "it closed the connection"),
        (HEADER[:9], True, "it broke off in mid-answer"),
        (b"", True, "it closed the connection"),
    ],
)
def test_an_answer_that_breaks_off_is_an_error_not_a_loop_without_end(
    answer: bytes, dies: bool, message: str
) -> None:
    server = Server(answer, dies=dies)
    try:
        with (
            pytest.raises(ServoError, match=message),
            opened(server.settings.host, server.settings.port, 0.2) as client,
        ):
            client.script_status(0)
    finally:
        server.close()


@pytest.mark.parametrize("host", ["no such host", "a..b"])
def test_a_host_that_is_none_is_one_line_too(host: str) -> None:
    with (
        pytest.raises(ServoError, match=rf"^pigpiod at {host}:8888: [^\n]+$"),
        opened(host, 8888),
    ):
        pass
