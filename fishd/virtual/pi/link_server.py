"""Server of a virtual Pi for other processes on a Unix socket, run by `fishctl virtual-pi run`."""

import contextlib
import errno
import os
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec

from fishd.core.errors import StartupError
from fishd.core.process.unix_sockets import bind, claim_socket
from fishd.virtual.pi.i2c import Message, Read, Write
from fishd.virtual.pi.link import LONG_POLL_TIMEOUT_S, MAX_PACKET_BYTES, Call, Done, Failed
from fishd.virtual.pi.virtual_pi import VirtualPi


class LinkServer:
    """Virtual Pi with a server, one thread per connection; a context manager."""

    def __init__(self, pi: VirtualPi, path: Path) -> None:
        self._pi = pi
        self._path = path
        self._operations: dict[str, Callable[..., Any]] = {
            "transfer": self._transfer,
            "set_timeout": self._set_timeout,
            "inject": pi.faults.inject,
            "clear": pi.faults.clear,
            "set_level": pi.set_level,
            "await_levels": lambda known: pi.levels(known, LONG_POLL_TIMEOUT_S),
            "state": pi.state,
        }
        self._connections: dict[socket.socket, threading.Thread] = {}
        self._lock = threading.Lock()
        self._stack = ExitStack()

    def start(self) -> None:
        """Start the virtual Pi and listen.

        Raises `StartupError` when another virtual Pi listens there or the place cannot be used.
        """
        path = self._path.resolve()  # a symbolic link names the same virtual Pi
        advice = "end it, or give this one another virtual_pi.socket"
        with ExitStack() as stack:
            stack.enter_context(claim_socket(path, str(path), "another virtual Pi", advice))
            stack.enter_context(self._pi)
            listener = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
            try:
                bind(listener, path, 0o177)  # accessible to this user only
                listener.listen()
            except OSError as error:
                raise StartupError(
                    f"virtual_pi.socket: cannot listen on {path}: {error.strerror or error}; "
                    "choose another path"
                ) from None
            acceptor = threading.Thread(target=self._accept, args=(listener,), daemon=True)
            acceptor.start()
            stack.callback(self._hang_up)
            stack.callback(acceptor.join)
            stack.callback(_shut_down, listener)
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Close all connections and stop the virtual Pi; may be called twice."""
        self._stack.close()

    def __enter__(self) -> "LinkServer":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:  # closed
                return
            thread = threading.Thread(target=self._serve, args=(connection,), daemon=True)
            with self._lock:
                self._connections[connection] = thread
            thread.start()

    def _hang_up(self) -> None:
        with self._lock:
            connections = dict(self._connections)
        for connection, thread in connections.items():
            _shut_down(connection)
            thread.join()

    def _serve(self, connection: socket.socket) -> None:
        decode = msgspec.msgpack.Decoder(Call).decode
        encode = msgspec.msgpack.Encoder().encode
        with connection:
            try:
                while packet := connection.recv(MAX_PACKET_BYTES):
                    if _has_hung_up(connection):  # the client has abandoned this request
                        break
                    connection.send(encode(self._answer(decode, packet)))
            except OSError:  # the client disconnected before the reply
                pass
            finally:
                with self._lock:
                    del self._connections[connection]

    def _answer(self, decode: Callable[[bytes], Call], packet: bytes) -> Done | Failed:
        try:
            call = decode(packet)
            return Done(self._operations[call.operation](*call.arguments))
        except OSError as error:
            number = error.errno or errno.EIO
            return Failed(number, error.strerror or os.strerror(number))
        except (ValueError, TypeError, LookupError, msgspec.MsgspecError) as error:
            return Failed(0, str(error))

    def _transfer(self, address: int, messages: list[bytes | int], asked: float) -> list[bytes]:
        """Perform a transfer; messages: bytes to write, or the number of bytes to read."""
        return self._pi.bus.transfer(address, [_message(encoded) for encoded in messages], asked)

    def _set_timeout(self, seconds: float) -> None:
        self._pi.bus.timeout = seconds


def _message(encoded: bytes | int) -> Message:
    return Read(encoded) if isinstance(encoded, int) else Write(encoded)


def _has_hung_up(connection: socket.socket) -> bool:
    try:
        return not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False


def _shut_down(connection: socket.socket) -> None:
    """Shut down a socket, which wakes up the thread that waits for it."""
    with contextlib.suppress(OSError):  # already disconnected
        connection.shutdown(socket.SHUT_RDWR)
