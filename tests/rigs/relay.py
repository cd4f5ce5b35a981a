"""Way between a client and the control socket of a fishd that can fall silent without an end."""

import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress


class Relay:
    """Unix socket whose connections lead to another one, unless it is silent."""

    def __init__(self, path: str, target: str) -> None:
        self.endpoint = f"ipc://{path}"
        self._target = target.removeprefix("ipc://")
        self._passes = threading.Event()
        self._passes.set()
        self.listener = socket.socket(socket.AF_UNIX)
        self.listener.bind(path)
        self.listener.listen(100)
        _start(self._accept)

    def fall_silent(self) -> None:
        """Keep all connections, and what they send."""
        self._passes.clear()

    def speak_again(self) -> None:
        """Pass on what was kept, and what comes."""
        self._passes.set()

    def _accept(self) -> None:
        with self.listener:
            while True:
                client, _ = self.listener.accept()
                _start(self._connect, client)

    def _connect(self, client: socket.socket) -> None:
        with client, socket.socket(socket.AF_UNIX) as server:
            self._passes.wait()
            server.connect(self._target)
            requests = _start(self._pump, client, server)
            self._pump(server, client)
            requests.join()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):  # one end has gone
            while data := source.recv(2**16):
                self._passes.wait()
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


def _start(function: Callable[..., None], *arguments: object) -> threading.Thread:
    def run() -> None:
        with suppress(OSError):  # the other end has gone
            function(*arguments)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


@contextmanager
def relayed(path: str | os.PathLike[str], target: str) -> Iterator[Relay]:
    """Yield a relay to an endpoint, which listens at this path until the context ends."""
    relay = Relay(os.fspath(path), target)
    try:
        yield relay
    finally:
        relay.speak_again()
        relay.listener.shutdown(socket.SHUT_RDWR)
