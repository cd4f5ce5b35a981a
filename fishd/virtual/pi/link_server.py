"""Offers a virtual Pi to other processes on a Unix socket; `fishctl virtual-pi run` runs it."""

import contextlib
import errno
import os
import socket
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec

from fishd.core.errors import StartupError
from fishd.core.process.unix_sockets import bind, claim_socket
from fishd.virtual.pi.i2c import Message, Read, Write
from fishd.virtual.pi.link import (
    LONG_POLL,
    PACKET,
    AnyRequest,
    AwaitLevels,
    Clear,
    Done,
    Failed,
    Inject,
    SetLevel,
    SetTimeout,
    Transfer,
)
from fishd.virtual.pi.virtual_pi import VirtualPi


class LinkServer:
    """Runs a virtual Pi and serves it, a thread per connection; use it as a context manager."""

    def __init__(self, pi: VirtualPi, path: Path) -> None:
        self._pi = pi
        self._path = path
        self._connections: dict[socket.socket, threading.Thread] = {}
        self._lock = threading.Lock()
        self._stack = ExitStack()

    def start(self) -> None:
        """Start the virtual Pi and listen.

        Raises `StartupError` when another virtual Pi listens there or the place cannot be used.
        """
        path = self._path.resolve()  # a symbolic link leads to the same virtual Pi
        advice = "end it, or give this one another virtual_pi.socket"
        with ExitStack() as stack:
            stack.enter_context(claim_socket(path, str(path), "another virtual Pi", advice))
            stack.enter_context(self._pi)
            listener = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
            try:
                bind(listener, path, 0o177)  # for this user alone, from the first moment
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
            stack.callback(_shut, listener)
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Hang up and stop the virtual Pi; may be called twice."""
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
            _shut(connection)
            thread.join()

    def _serve(self, connection: socket.socket) -> None:
        decode = msgspec.msgpack.Decoder(AnyRequest).decode
        encode = msgspec.msgpack.Encoder().encode
        with connection:
            try:
                while packet := connection.recv(PACKET):
                    if _has_hung_up(connection):  # it has given this request up
                        break
                    connection.send(encode(self._answer(decode, packet)))
            except OSError:  # the client went away before it had its reply
                pass
            finally:
                with self._lock:
                    del self._connections[connection]

    def _answer(self, decode: Any, packet: bytes) -> Done | Failed:
        try:
            return Done(self._perform(decode(packet)))
        except OSError as error:
            number = error.errno or errno.EIO
            return Failed(number, error.strerror or os.strerror(number))
        except (ValueError, msgspec.MsgspecError) as error:
            return Failed(0, str(error))

    def _perform(self, request: AnyRequest) -> Any:
        pi = self._pi
        match request:
            case Transfer(address, messages, asked):
                return pi.bus.transfer(address, [_message(spoken) for spoken in messages], asked)
            case SetTimeout(seconds):
                pi.bus.timeout = seconds
            case Inject(name, seconds):
                pi.faults.inject(name, seconds)
            case Clear(name):
                pi.faults.clear(name)
            case SetLevel(gpio, level):
                pi.set_level(gpio, level)
            case AwaitLevels(known):
                return pi.levels(known, LONG_POLL)
            case _:
                return pi.state()
        return None


def _message(spoken: bytes | int) -> Message:
    return Read(spoken) if isinstance(spoken, int) else Write(spoken)


def _has_hung_up(connection: socket.socket) -> bool:
    try:
        return not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False


def _shut(connection: socket.socket) -> None:
    """Wake up the thread that waits on a socket."""
    with contextlib.suppress(OSError):  # not connected any more
        connection.shutdown(socket.SHUT_RDWR)
