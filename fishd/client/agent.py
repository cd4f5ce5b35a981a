"""`Agent`: a program that supplies angles to the controller `remote`; see docs/how-to/remote.md."""

import contextlib
import math
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Self

import msgspec
import zmq

from fishd.client.zmq_sockets import milliseconds_until
from fishd.core.addresses import claim_address, is_ipv6, parse
from fishd.core.agent_messages import (
    MAX_MESSAGE,
    VERSION,
    Action,
    Ended,
    FromAgent,
    Observed,
    Pause,
    decode_from_fish,
    encode,
)
from fishd.core.errors import FishError, NoDaemon, ParameterError, StartupError

DEFAULT_TIMEOUT_S = 10.0
"""Default time to wait for an observation [s]."""


class Agent:
    """Receiver of observations of a fishd, which it answers; a context manager, for one thread.

    It binds an address, and fishd connects: `fish.set_controller("remote", agent=agent.address)`.
    It serves the session that sent the latest observation: a restarted fishd begins a new one.
    """

    def __init__(
        self, address: str = "tcp://127.0.0.1:*", *, timeout: float | None = DEFAULT_TIMEOUT_S
    ) -> None:
        """
        address: address at which fishd can reach this program, tcp://HOST:PORT or ipc://PATH; `*`
            is any free port
        timeout: time to wait for an observation [s]; None for no limit

        Raises `FishError` if the address is invalid or in use.
        """
        self.timeout = timeout
        self.latest: Observed | None = None
        """The latest observation, which `act` answers."""
        self.active = False
        """False before the first observation, and after fishd has ended the session."""
        self.lost = 0
        """Number of ticks without an action in time, between the latest two received
        observations."""
        self._peer = b""
        self._past: deque[str] = deque(maxlen=100)
        """Ended sessions, whose late messages are ignored."""
        self._strange = ""
        """Description of the latest message that was not one of a fishd."""
        with ExitStack() as stack:
            self._socket = _bind_socket(address, stack)
            self._stack = stack.pop_all()
        self.address = self._socket.get_string(zmq.LAST_ENDPOINT)
        """Address to give to fishd."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._stack.close()

    def __iter__(self) -> Iterator[Observed]:
        """Yield every observation, to be answered with `act`; raise `NoDaemon` if none comes."""
        while True:
            yield self.observe()

    def observe(self) -> Observed:
        """Return the next observation, the newest if several are waiting; raise `NoDaemon`."""
        deadline = None if self.timeout is None else time.monotonic() + self.timeout
        while True:
            remaining = None if deadline is None else deadline - time.monotonic()
            observation = self.poll(remaining)
            if observation:
                return observation
            if remaining is not None and remaining <= 0.0:
                raise self._nothing()

    def poll(self, seconds: float | None = 0.0) -> Observed | None:
        """Return the next observation; None after this time [s], or if fishd ends the session."""
        deadline = None if seconds is None else time.monotonic() + max(0.0, seconds)
        while self._socket.poll(None if deadline is None else milliseconds_until(deadline)):
            before, self.lost, is_new = self.latest, 0, False
            while self._socket.poll(0):
                is_new = self._take() or is_new
            if is_new and self.active:
                return self.latest
            if before and not self.active:
                return None
        return None

    def act(self, angle: float) -> None:
        """Answer the latest observation with an instruction angle [rad], without waiting.

        Raise `ParameterError` if it is not a finite number, `NoDaemon` without an observation.
        """
        if not math.isfinite(angle):
            raise ParameterError(f"an instruction angle of {angle} is not a number")
        asked = self._asked()
        self._send(Action(session=asked.session, seq=asked.seq, phi_c=float(angle)))

    def pause(self, seconds: float) -> None:
        """Pause instead of an action: the fish waits at neutral, and sends no observations.

        seconds: time after which an agent that has not called `resume` counts as silent; up to 3600
        """
        if not 0.0 < seconds <= 3600.0:
            raise ParameterError(f"a pause of {seconds:g} s is not valid: more than 0, up to 3600")
        self._send(Pause(session=self._asked().session, seconds=float(seconds)))

    def resume(self) -> None:
        """End a pause; the next observation is one after the pause."""
        self.poll()  # receive what was sent before the pause began
        self._send(Pause(session=self._asked().session, seconds=0.0))

    def _asked(self) -> Observed:
        if self.latest is None:
            raise self._nothing()
        return self.latest

    def _send(self, message: FromAgent) -> None:
        with contextlib.suppress(zmq.Again):  # a fishd that does not read loses the message
            self._socket.send_multipart((self._peer, encode(message)), zmq.DONTWAIT)

    def _take(self) -> bool:
        """Receive one message; return whether it is an observation to be answered."""
        peer, *frames = self._socket.recv_multipart()
        try:
            message = decode_from_fish(b"".join(frames))
        except msgspec.DecodeError as error:
            self._strange = str(error)
            return False
        if message.v != VERSION:
            self._strange = f"a message of version {message.v}; version {VERSION} is needed"
            return False
        if message.session in self._past:
            return False
        if isinstance(message, Ended):
            if self.latest and message.session == self.latest.session:
                self.active = False
            self._past.append(message.session)
            return False
        if self.latest and message.session != self.latest.session:
            self._past.append(self.latest.session)
            self.lost = 0
        elif self.latest and message.seq == self.latest.seq:
            return True  # sent again after a pause
        self.lost += message.lost_ticks
        self._peer, self.latest, self.active = peer, message, True
        return True

    def _nothing(self) -> NoDaemon:
        why = f"no observation has come to {self.address}"
        if self.timeout is not None:
            why += f" within {self.timeout:g} s"
        if self._strange:
            return NoDaemon(f"{why}, but an invalid message: {self._strange}")
        if self.latest and not self.active:
            return NoDaemon(f"{why}: another controller is active, or none")
        return NoDaemon(
            f"{why}; start fishd, and run 'fishctl set-controller remote --agent {self.address}'"
        )


def _bind_socket(address: str, stack: ExitStack) -> "zmq.Socket[bytes]":
    """Return a socket that listens at the address until the stack is closed; raise `FishError`."""
    try:
        parse(address)
        stack.enter_context(claim_address(address, "another program", "choose another address"))
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.destroy, linger=100)
        socket = context.socket(zmq.ROUTER)
        socket.set(zmq.MAXMSGSIZE, MAX_MESSAGE)
        socket.set(zmq.LINGER, 100)
        socket.set(zmq.IPV6, is_ipv6(address))
        socket.bind(address)
        return socket
    except StartupError as error:
        raise FishError(f"an agent cannot listen on '{address}': {error}") from None
    except zmq.ZMQError as error:
        why = zmq.strerror(error.errno or 0)
    except ValueError as error:
        why = str(error)
    raise FishError(
        f"an agent cannot listen on '{address}': {why}; "
        "write tcp://127.0.0.1:* for any free port, tcp://HOST:PORT or ipc://PATH"
    )
