"""`Agent`: what the controller `remote` of a fishd asks for angles; see docs/how-to/remote.md."""

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

PATIENCE = 10.0
"""How long to wait for an observation [s]."""


class Agent:
    """Takes observations from a fishd and answers them; a context manager, for one thread.

    It binds an address, and fishd connects: `fish.set_controller("remote", agent=agent.address)`.
    Whoever asks last is served: a fishd that ends and comes back begins a new session.
    """

    def __init__(
        self, address: str = "tcp://127.0.0.1:*", *, timeout: float | None = PATIENCE
    ) -> None:
        """
        address: where fishd can reach this program, tcp://HOST:PORT or ipc://PATH; port * is any
        timeout: how long to wait for an observation [s]; None for ever

        Raises `FishError` when the address is none, or somebody is there already.
        """
        self.timeout = timeout
        self.latest: Observed | None = None
        """What `act` answers."""
        self.active = False
        """False before the first observation, and once fishd has said that it was the last."""
        self.lost = 0
        """Ticks without an action in time, between the latest two observations that were taken."""
        self._peer = b""
        self._past: deque[str] = deque(maxlen=100)
        """Sessions that are over, whatever may still come from them."""
        self._strange = ""
        """What came last that was no message of a fishd."""
        with ExitStack() as stack:
            self._socket = _bound(address, stack)
            self._stack = stack.pop_all()
        self.address = self._socket.get_string(zmq.LAST_ENDPOINT)
        """What fishd has to be told."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._stack.close()

    def __iter__(self) -> Iterator[Observed]:
        """Every observation, to be answered with `act`; raises `NoDaemon` when none comes."""
        while True:
            yield self.observe()

    def observe(self) -> Observed:
        """The next observation, the newest where several have come; raises `NoDaemon`."""
        deadline = None if self.timeout is None else time.monotonic() + self.timeout
        while True:
            left = None if deadline is None else deadline - time.monotonic()
            found = self.poll(left)
            if found:
                return found
            if left is not None and left <= 0.0:
                raise self._nothing()

    def poll(self, seconds: float | None = 0.0) -> Observed | None:
        """`observe`, or None after a while and as soon as fishd says that there will be no more."""
        deadline = None if seconds is None else time.monotonic() + max(0.0, seconds)
        while self._socket.poll(None if deadline is None else milliseconds_until(deadline)):
            before, self.lost, found = self.latest, 0, False
            while self._socket.poll(0):
                found = self._take() or found
            if found and self.active:
                return self.latest
            if before and not self.active:
                return None
        return None

    def act(self, angle: float) -> None:
        """Answer the latest observation with an instruction angle [rad], and do not wait.

        Raises `ParameterError` when it is no finite number, `NoDaemon` when nobody has asked.
        """
        if not math.isfinite(angle):
            raise ParameterError(f"an instruction angle of {angle} is not a number")
        asked = self._asked()
        self._send(Action(session=asked.session, seq=asked.seq, phi_c=float(angle)))

    def pause(self, seconds: float) -> None:
        """In place of an action: the fish waits at neutral, and nothing is observed, for a while.

        seconds: when it is over without `resume`, the agent counts as silent; up to 3600
        """
        if not 0.0 < seconds <= 3600.0:
            raise ParameterError(f"a pause of {seconds:g} s is not valid: more than 0, up to 3600")
        self._send(Pause(session=self._asked().session, seconds=float(seconds)))

    def resume(self) -> None:
        """End a pause; the next observation is one from after it."""
        self.poll()  # what was on its way when the pause began
        self._send(Pause(session=self._asked().session, seconds=0.0))

    def _asked(self) -> Observed:
        if self.latest is None:
            raise self._nothing()
        return self.latest

    def _send(self, message: FromAgent) -> None:
        with contextlib.suppress(zmq.Again):  # a fishd that does not read misses it
            self._socket.send_multipart((self._peer, encode(message)), zmq.DONTWAIT)

    def _take(self) -> bool:
        """Receive one message; True when it is an observation to be answered."""
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
            return True  # once more, after a pause
        self.lost += message.lost
        self._peer, self.latest, self.active = peer, message, True
        return True

    def _nothing(self) -> NoDaemon:
        why = f"no observation has come to {self.address}"
        if self.timeout is not None:
            why += f" within {self.timeout:g} s"
        if self._strange:
            return NoDaemon(f"{why}, but what is none: {self._strange}")
        if self.latest and not self.active:
            return NoDaemon(f"{why}: another controller is active, or none")
        return NoDaemon(
            f"{why}: is a fishd running, and was it asked to "
            f"'fishctl set-controller remote --agent {self.address}'?"
        )


def _bound(address: str, stack: ExitStack) -> "zmq.Socket[bytes]":
    """A socket that listens there until the stack is closed; raises `FishError`."""
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
