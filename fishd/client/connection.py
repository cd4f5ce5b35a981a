"""What both clients share: sockets, the form of requests and replies, and complaints."""

import itertools
import math
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

import msgspec

from fishd.core import protocol, text
from fishd.core.addresses import (
    ENDPOINT_VARIABLE,
    estop_path,
    find_control_address,
    socket_path,
)
from fishd.core.decoding import decoder
from fishd.core.errors import (
    FishError,
    LeaseLost,
    NoDaemon,
    ParameterError,
    Refused,
    Untrusted,
)
from fishd.core.process.unix_sockets import Listener, find_listener, find_trust_problem, is_deserted
from fishd.core.protocol import State

if TYPE_CHECKING:
    from fishd.client.lease import LeaseRenewal

T = TypeVar("T")

TIMEOUT = 2.0
"""How long to wait for an answer [s]."""
IDLE_LIMIT = 30.0
"""Time after which a program that does nothing while the fish swims counts as hung [s]."""
SECOND_LOOK = 500
"""What has not come in time is looked for once more, for so long: of a process that was itself held
up, by SIGSTOP say, it has come, but no thread has read it yet [ms].
"""
ESTOP_WAIT_S = 0.1
"""Time after which an emergency stop goes to fishd's own socket as well [s]."""
ESTOP_SOCKET_WAIT_S = 0.4
"""Longest time to wait for the answer from there [s]."""


class Connection:
    """What both clients share: addresses, the form of requests and replies, and complaints."""

    def __init__(self, endpoint: str | None, timeout: float, telemetry: str | None) -> None:
        self.endpoint = endpoint or find_control_address()
        self._path = socket_path(self.endpoint)
        self._was_named = bool(endpoint or os.environ.get(ENDPOINT_VARIABLE))
        self.timeout = timeout
        self.telemetry_address = telemetry
        self.held: LeaseRenewal | None = None
        """The lease of the fish, inside `with fish.lease(...)`."""
        self._ids = itertools.count(1)
        self.estop_taken_by = ""
        """Which socket answered the latest emergency stop: `control` or `estop`."""

    def check_endpoint(self) -> None:
        """Spare the wait where it is certain that nobody will answer; raises `NoDaemon`.

        Raises `Untrusted` where a stranger would. An endpoint that the user named is trusted.
        """
        if self._path and is_deserted(self._path):
            raise self._nobody("nobody listens there")
        try:
            self._listener()
        except PermissionError:
            raise NoDaemon(
                f"this user may not ask the fishd at {self.endpoint}: join the group of its socket "
                "('sudo usermod -aG fishd USER' for the service), log in again, then try again"
            ) from None
        if self._path and not self._was_named and (why := find_trust_problem(self._path)):
            raise Untrusted(
                f"what listens at {self.endpoint} is not asked, it may be anybody: {why}; where "
                "you trust it, name it with --endpoint or $FISHD_ENDPOINT"
            )

    def _nobody(self, why: str) -> NoDaemon:
        return NoDaemon(
            f"no fishd at {self.endpoint}: {why}; start one with 'fishd', or name another with "
            "--endpoint or $FISHD_ENDPOINT"
        )

    def silent(self, patience: float = 0.0) -> NoDaemon:
        """What to raise when no answer comes in time; patience: beyond the time-out [s]."""
        why = f"no answer within {self.timeout + patience:g} s"
        try:
            found = self._listener()
        except PermissionError:
            found = None
        if found is None:
            return self._nobody(why)
        return NoDaemon(
            f"{why} from process {found.pid}, which serves {self.endpoint}: it hangs, is stopped "
            "or is overloaded; 'fishctl release --config FILE' stops the servo without it"
        )

    def _listener(self) -> Listener | None:
        """Who listens, where that can be told; raises PermissionError."""
        return find_listener(self._path) if self._path else None

    def request(self, op: str, args: Mapping[str, Any]) -> tuple[int, bytes]:
        """Return a new id, and the request as JSON.

        Raises `ParameterError` for NaN, infinity and text that is not UTF-8.
        """
        identity = next(self._ids)
        arguments = protocol.OPERATIONS[op].arguments
        if self.held and "lease" in arguments.__struct_fields__:
            args = {"lease": self.held.token, **args}
        for name, value in args.get("parameters", {}).items():
            if isinstance(value, float) and not math.isfinite(value):  # JSON would make it null
                raise ParameterError(f"{name}: {value} is not a number that can be sent")
        request = protocol.Request(v=protocol.VERSION, id=identity, op=op, args=dict(args))
        try:
            payload = protocol.encode(request)
        except UnicodeEncodeError as error:  # bytes of a command line that are not UTF-8
            if op != "estop":
                what = text.quoted(error.object)
                raise ParameterError(f"{op}: '{what}' is not a text in UTF-8") from None
            message = args["message"].encode("utf-8", "replace").decode()
            payload = protocol.encode(msgspec.structs.replace(request, args={"message": message}))
        if len(payload) > protocol.MAX_MESSAGE:
            raise ParameterError(f"{op}: the request is longer than {protocol.MAX_MESSAGE} bytes")
        return identity, payload

    def estop_without_gateway(self, message: str) -> State | None:
        """Ask for an emergency stop at fishd's own socket; None where nothing answers there."""
        path = estop_path(self.endpoint)
        identity, request = self.request("estop", {"message": message})
        if path is None:
            return None
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
            client.settimeout(ESTOP_SOCKET_WAIT_S)
            try:
                client.bind("")  # any free name: the answer needs one
                client.connect(os.fspath(path))
                client.send(request)
                reply = client.recv(2**20)
            except OSError:
                return None
        self.estop_taken_by = "estop"
        return self.result((reply,), identity, State)

    def result(self, frames: Sequence[bytes], identity: int, kind: type[T]) -> T | None:
        """The result in a reply; None when it answers an earlier request that timed out."""
        reply: protocol.Reply = self.read(protocol.decode_reply, frames)
        if reply.id != identity:
            return None
        if reply.error:
            kind_of_error = LeaseLost if reply.error.code == "no-lease" else Refused
            raise kind_of_error(text.quoted(reply.error.code), text.line(reply.error.message))
        return cast(T, self.read(decoder(kind), (reply.result or b"",)))

    def read(self, decode: Callable[[bytes], T], frames: Sequence[bytes]) -> T:
        """What the last frame of a message says; raises `FishError` where that is nothing known."""
        if self.held:
            self.held.used = time.monotonic()
        try:
            return decode(frames[-1])
        except msgspec.DecodeError as error:
            why = text.line(str(error))
            raise FishError(
                f"what answers at {self.endpoint} is no fishd of this version: {why}"
            ) from None

    def check_lease(self) -> None:
        """Raise `LeaseLost` where the fish was leased, and is not any more."""
        if self.held and self.held.lost:
            raise self.held.lost

    def telemetry_silent(self) -> NoDaemon:
        """What to raise when no telemetry comes in time."""
        return self._nobody(f"no telemetry within {self.timeout:g} s")


def deadlines(seconds: float, *, again: bool) -> Iterator[float]:
    """Until when to wait for an answer, `seconds` from now, then for a second look [s, monotonic].

    again: whether there is a second look
    """
    yield time.monotonic() + seconds
    if again:
        yield time.monotonic() + SECOND_LOOK * 1e-3
