"""The socket between the controller `remote` and its agent; only `wait` blocks."""

import re
import secrets
import select
from collections.abc import Callable
from contextlib import ExitStack

import msgspec
import zmq

from fishd.controllers.remote.messages import MAX_MESSAGE, VERSION, FromAgent, decode_from_agent
from fishd.core.addresses import FORM, is_ipv6
from fishd.core.decoding import decoder
from fishd.core.errors import ControllerFault, ParameterError

_QUEUE = 100
"""Messages kept in either direction; an agent that does not read gets no more than these."""
_FAREWELL = 200
"""How long the last message may take to leave, in the background [ms]."""
_SHOWN = 200
"""How much of a bad message is shown [bytes]."""


def start_context(stack: ExitStack) -> None:
    """Start ZeroMQ's thread of this process; leaving `stack` ends it, and every socket.

    Done at start, it gets its priority with the other threads, and no tick has to wait for it.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
    stack.callback(context.destroy, linger=_FAREWELL)
    context.socket(zmq.PAIR).close()


class _Versioned(msgspec.Struct):
    """Any message, as far as every version will have it."""

    v: int = VERSION


_decode_version: Callable[[bytes], _Versioned] = decoder(_Versioned)


class Wire:
    """A DEALER socket that connects to the agent, and connects again when it was lost."""

    def __init__(self, address: str, *, counted: bool = False) -> None:
        """
        counted: count the connections

        Raises `ParameterError` where ZeroMQ refuses the address.
        """
        self._address = address
        self.connections = 0
        """How many there were until the latest `state`, where they are counted."""
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        self._socket = context.socket(zmq.DEALER)
        self._socket.set(zmq.IMMEDIATE, 1)  # nothing old waits for an agent that comes late
        self._socket.set(zmq.SNDHWM, _QUEUE)
        self._socket.set(zmq.RCVHWM, _QUEUE)
        self._socket.set(zmq.MAXMSGSIZE, MAX_MESSAGE)
        self._connected: zmq.Socket[bytes] | None = None
        """Has a message for each connection, before anything can be sent over it."""
        if counted:
            name = f"inproc://remote-{secrets.token_hex(8)}"
            self._connected = self._socket.get_monitor_socket(zmq.EVENT_CONNECTED, name)
        try:
            self._socket.set(zmq.IPV6, is_ipv6(address))
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self._end(linger=0)
            raise ParameterError(
                f"agent: cannot connect to '{address}': {zmq.strerror(error.errno or 0)}; {FORM}",
                ("agent",),
            ) from None

    def fileno(self) -> int:
        """A descriptor that is readable once `state` may have changed."""
        return self._socket.FD

    def state(self) -> tuple[bool, bool]:
        """Can a message be sent, and is there one to receive?"""
        events = int(self._socket.get(zmq.EVENTS))
        while self._has_connected():  # then the events may have been those of a lost connection
            self.connections += 1
            events = int(self._socket.get(zmq.EVENTS))
        return bool(events & zmq.POLLOUT), bool(events & zmq.POLLIN)

    def send(self, payload: bytes) -> None:
        """Send a message, where `state` says that this is possible."""
        self._socket.send(payload, zmq.DONTWAIT)

    def receive(self) -> FromAgent:
        """A message, where `state` says that there is one.

        Raises `ControllerFault` when it is not a message that an agent may send.
        """
        frames = self._socket.recv_multipart(zmq.DONTWAIT)
        if len(frames) != 1:
            raise self._bad(f"a message of {len(frames)} frames; one frame of JSON is needed")
        try:
            message = decode_from_agent(frames[0])
        except msgspec.DecodeError as error:  # of the syntax, or of what is in it
            raise self._bad(_why(frames[0], error)) from None
        if message.v != VERSION:
            raise self._bad(_other_version(message.v))
        return message

    def wait(self, seconds: float) -> None:
        """Return when `state` has changed, or after a while."""
        # zmq_poll and epoll count whole milliseconds, too coarse for a tick of a few.
        select.select([self._socket.FD], [], [], seconds)

    def close(self, farewell: bytes) -> None:
        """Send a last message if somebody takes it, and disconnect; may be called twice."""
        if self._socket.closed:
            return
        if self.state()[0]:
            self._socket.send(farewell, zmq.DONTWAIT)
        self._end(linger=_FAREWELL)

    def _has_connected(self) -> bool:
        """Has it since this was last asked?"""
        if self._connected is None or not int(self._connected.get(zmq.EVENTS)) & zmq.POLLIN:
            return False
        self._connected.recv_multipart(zmq.DONTWAIT)
        return True

    def _end(self, linger: int) -> None:
        if self._connected:
            self._socket.disable_monitor()
            self._connected.close(linger=0)
        self._socket.close(linger=linger)

    def _bad(self, what: str) -> ControllerFault:
        return ControllerFault("remote-error", f"the agent at {self._address} sent {what}")


def _why(payload: bytes, error: msgspec.DecodeError) -> str:
    try:
        version = _decode_version(payload).v
    except msgspec.DecodeError:
        version = VERSION
    if version != VERSION:
        return _other_version(version)
    return f"{_excerpt(payload, str(error))!r}, which is neither an action nor a pause: {error}"


def _excerpt(payload: bytes, error: str) -> str:
    """As much of a message as shows what is wrong: around the byte that the decoder names."""
    found = re.search(r"\(byte (\d+)\)", error)
    begin = max(0, int(found[1]) - _SHOWN // 2) if found and len(payload) > _SHOWN else 0
    shown = payload[begin : begin + _SHOWN]
    before, after = "…" * (begin > 0), "…" * (begin + len(shown) < len(payload))
    return f"{before}{shown.decode(errors='replace')}{after}"


def _other_version(version: int) -> str:
    return f"a message of version {version}; this fishd needs version {VERSION}"
