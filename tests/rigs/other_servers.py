"""Servers that are not pigpiod, each on a port that the kernel chooses."""

import contextlib
import http.server
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator


def _answer_http(client: socket.socket) -> None:
    """Answer as an HTTP server that reads whole lines, such as Python's."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    Handler(client, client.getpeername(), None)  # type: ignore[arg-type]


def _send(data: bytes, count: int | None = None) -> Callable[[socket.socket], None]:
    """Return the answer of a server that sends something, after `count` bytes if it is given."""

    def answer(client: socket.socket) -> None:
        if count:
            client.recv(count, socket.MSG_WAITALL)
        client.sendall(data)
        _be_silent(client)

    return answer


def _be_silent(client: socket.socket) -> None:
    while client.recv(4096):
        pass


def _echo(client: socket.socket) -> None:
    while data := client.recv(4096):
        client.sendall(data)


SERVERS: dict[str, Callable[[socket.socket], None]] = {
    "http": _answer_http,
    "http-at-once": _send(b"HTTP/1.1 400 Bad Request\r\nServer: nginx\r\n\r\n", 16),
    "ssh": _send(b"SSH-2.0-OpenSSH_9.2p1 Debian-2\r\n"),
    "ftp": _send(b"220 ftp\r\n"),
    "garbage": _send(os.urandom(15) + b"\0", 16),
    "no-version": _send(struct.pack("<4I", 26, 0, 0, 0xFFFFFFFF), 16),
    "echo": _echo,
    "silent": _be_silent,
    "closing": lambda client: None,
}
"""What each server does with a connection, by its name; it then closes the connection."""


@contextlib.contextmanager
def other_server(name: str) -> Iterator[int]:
    """Run a server; return its port."""
    clients: list[socket.socket] = []

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                clients.append(client)
                threading.Thread(target=answer, args=(client,), daemon=True).start()

    def answer(client: socket.socket) -> None:
        with contextlib.suppress(OSError), client:
            SERVERS[name](client)
            client.shutdown(socket.SHUT_RDWR)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()
        for client in clients:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
