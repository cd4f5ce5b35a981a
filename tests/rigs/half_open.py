"""TCP connections that die without an end, as in a router that forgets them or a hung tunnel."""

import socket
import threading
from contextlib import suppress
from typing import Self

HOST, PATH_HOST = "127.0.0.1", "127.0.0.2"
"""Host of the programs, and the host at which they are reached through a path; of equal length."""
_CHUNK = 65536


class Path:
    """Path to the TCP ports of programs on this machine; a context manager.

    It leads from the same ports of another host, also in the addresses that the programs send. Each
    port can be cut off: its connections forward nothing any more, in neither direction, and are not
    closed; the kernel accepts new ones, which get no answer.
    """

    def __init__(self, *ports: int, host: str = PATH_HOST) -> None:
        """host: where it begins, of the length of `PATH_HOST`"""
        self._host = host
        self._open = {port: threading.Event() for port in ports}
        self._connections: list[tuple[int, threading.Event, socket.socket]] = []
        """Port, whether it still forwards, and one of its two sockets."""
        self._lock = threading.Lock()
        self._ended = False
        self._listeners, self._threads = [], []
        for port, is_open in self._open.items():
            is_open.set()
            listener = socket.create_server((host, port), backlog=100)
            thread = threading.Thread(target=self._accept, args=(port, listener), daemon=True)
            thread.start()
            self._listeners.append(listener)
            self._threads.append(thread)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        for is_open in self._open.values():
            is_open.set()
        for listener in self._listeners:
            with suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for listener in self._listeners:
            listener.close()
        for _, _, end in self._connections:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def forget(self, *ports: int) -> None:
        """Forget the present connections of some ports; new ones are forwarded."""
        with self._lock:
            for port, forwards, _ in self._connections:
                if port in ports:
                    forwards.clear()

    def cut(self, *ports: int) -> None:
        """Forward nothing of some ports until `restore`; present connections never again."""
        for port in ports:
            self._open[port].clear()
        self.forget(*ports)

    def restore(self, *ports: int) -> None:
        """Forward the new connections of some ports, those that wait included."""
        for port in ports:
            self._open[port].set()

    def _accept(self, port: int, listener: socket.socket) -> None:
        is_open = self._open[port]
        with suppress(OSError):  # the listener is shut down at the end
            while is_open.wait() and not self._ended:
                client, _ = listener.accept()
                is_open.wait()
                self._connect(port, client)

    def _connect(self, port: int, client: socket.socket) -> None:
        """Forward between a client and the program."""
        try:
            program = socket.create_connection((HOST, port))
        except OSError:  # the program has ended
            client.close()
            return
        forwards = threading.Event()
        with self._lock:
            if self._open[port].is_set():  # not cut since
                forwards.set()
            self._connections += [(port, forwards, client), (port, forwards, program)]
        for ends in ((client, program), (program, client)):
            arguments = (*ends, self._host, forwards)
            threading.Thread(target=_forward, args=arguments, daemon=True).start()


def _forward(
    source: socket.socket, target: socket.socket, host: str, forwards: threading.Event
) -> None:
    """Forward until an end closes; nothing, and no end, once the connection is forgotten."""
    here, there = f"tcp://{HOST}:".encode(), f"tcp://{host}:".encode()
    with suppress(OSError):
        while (data := source.recv(_CHUNK)) and forwards.is_set():
            target.sendall(data.replace(here, there))
        if forwards.is_set():
            for end in (target, source):
                end.shutdown(socket.SHUT_RDWR)
