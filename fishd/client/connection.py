"""Common part of both clients: addresses, encoding of requests and replies, and errors."""

import itertools
import math
import os
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar, cast

import msgspec
from msgspec import UNSET, UnsetType

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
from fishd.core.process.kernel_names import Holder
from fishd.core.process.unix_sockets import find_listener, find_trust_problem, is_deserted
from fishd.core.signals import Status

if TYPE_CHECKING:
    from fishd.client.lease import LeaseRenewal
    from fishd.core.keys import Access
    from fishd.core.local_daemons import LocalDaemon

T = TypeVar("T")

DEFAULT_TIMEOUT_S = 2.0
"""Default time to wait for an answer [s]."""
DEFAULT_IDLE_LIMIT_S = 30.0
"""Default time after which a program that does nothing while the fish swims counts as hung [s]."""
LATE_ANSWER_WAIT_MS = 500
"""Additional time to read an answer that is late: if this process was itself suspended, such as by
SIGSTOP, the answer has arrived, but no thread has read it yet [ms]."""
ESTOP_FALLBACK_DELAY_S = 0.1
"""Time after which an emergency stop is also sent to fishd's emergency socket [s]."""
ESTOP_SOCKET_TIMEOUT_S = 0.4
"""Maximum time to wait for the answer of a socket of fishd itself [s]."""
HUNG_TIMEOUT_S = 0.1
"""The same after the emergency socket has not answered: most likely, that fishd hangs [s]."""


class Connection:
    """Base of both clients: addresses, encoding of requests and replies, and errors."""

    def __init__(
        self,
        endpoint: str | None,
        timeout: float,
        telemetry: str | None,
        access: "Access | UnsetType | None" = UNSET,
    ) -> None:
        self.endpoint = endpoint or find_control_address()
        self._path = socket_path(self.endpoint)
        self.access = _find_access(self.endpoint) if access is UNSET else access
        """Keys of this client and of the fishd; None for a connection without keys."""
        self._was_named = bool(endpoint or os.environ.get(ENDPOINT_VARIABLE))
        self.detour = ""
        """How the latest answer came without the control socket; empty if it came through it."""
        self.silent: list[LocalDaemon] = []
        """The fishds that did not answer the latest emergency stop at their names."""
        self.timeout = timeout
        self.telemetry_address = telemetry
        self.held: LeaseRenewal | None = None
        """Lease of the fish, inside `with fish.lease(...)`."""
        self._ids = itertools.count(1)
        self.estop_taken_by = ""
        """Socket that answered the latest emergency stop: `control`, `estop` or `kernel`."""

    def check_endpoint(self) -> None:
        """Raise `NoDaemon` at once if it is certain that no fishd will answer.

        Raise `Untrusted` if the process of another user may answer. An endpoint that the user named
        is trusted.
        """
        if self.is_deserted:
            raise self._no_daemon("no process listens there")
        try:
            self._listener()
        except PermissionError:
            if any(daemon.user == os.geteuid() for daemon in self.find_local_daemons()):
                raise self._no_daemon("this user may not connect") from None
            raise NoDaemon(
                f"this user may not connect to the fishd at {self.endpoint}: join the group of its "
                "socket "
                "('sudo usermod -aG fishd USER' for the service), log in again, then try again"
            ) from None
        if self._path and not self._was_named and (why := find_trust_problem(self._path)):
            raise Untrusted(
                f"the process that listens at {self.endpoint} is not trusted: {why}; if "
                "you trust it, name it with --endpoint or $FISHD_ENDPOINT"
            )

    def _no_daemon(self, why: str) -> NoDaemon:
        problem = f"no fishd at {self.endpoint}: {why}"
        if elsewhere := self.find_local_daemons():
            from fishd.core import local_daemons

            where = local_daemons.describe(elsewhere, self._option)
            return NoDaemon(problem, f"; {where}")
        return NoDaemon(
            problem,
            "; start one with 'fishd', or a simulated fish that swims with 'make run'; or name "
            "another with --endpoint or $FISHD_ENDPOINT",
        )

    @property
    def _option(self) -> str:
        """Option with which another verb means this fishd; empty if it needs none."""
        return f" --endpoint {self.endpoint}" if self._was_named else ""

    def find_local_daemons(self) -> "list[LocalDaemon]":
        """Return the fishds of this machine that a client of this endpoint may mean."""
        from fishd.core import local_daemons

        daemons = local_daemons.find_own(self.endpoint if self._was_named else None)
        with suppress(PermissionError):
            listener = self._listener()
            here = [daemon for daemon in daemons if listener and daemon.pid == listener.pid]
            return here or daemons
        return daemons

    def no_answer_error(self, patience: float = 0.0) -> NoDaemon:
        """Return the error for a missing answer; patience: time beyond the timeout [s]."""
        why = f"no answer within {self.timeout + patience:g} s"
        try:
            listener = self._listener()
        except PermissionError:
            listener = None
        from fishd.core.names import find_name_problem  # only needed for this message

        if problem := find_name_problem(self.endpoint):
            return NoDaemon(f"no fishd at {self.endpoint}: {problem}")
        if listener is None:
            return self._no_daemon(why)
        from fishd.core.local_daemons import become

        return NoDaemon(
            f"{why} from process {listener}, which serves {self.endpoint}: it hangs, is stopped "
            "or is overloaded",
            f"; '{become(listener.user)}fishctl estop{self._option}' ends the pulses without it",
        )

    def lost_command_error(self, op: str) -> NoDaemon:
        """Return the error for a command whose connection was lost before the answer."""
        return NoDaemon(
            f"the connection to {self.endpoint} was lost before the answer to {op}: it is not "
            "known whether fishd has carried it out; 'fishctl status' shows the state of the fish"
        )

    def _listener(self) -> Holder | None:
        """Return the listener of a Unix socket, None if unknown; raise PermissionError."""
        return find_listener(self._path) if self._path else None

    def request(self, op: str, args: Mapping[str, Any]) -> tuple[int, bytes]:
        """Return a new id, and the request as JSON.

        Raise `ParameterError` for NaN, infinity and text that is not UTF-8.
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

    @property
    def is_deserted(self) -> bool:
        """Whether it is certain that no process listens at the endpoint."""
        return self._path is not None and is_deserted(self._path)

    def ask_without_gateway(
        self, kind: type[T], op: str, args: Mapping[str, Any], *, trusted: bool = True
    ) -> T | None:
        """Send a request to fishd's own sockets; return None if none answers.

        trusted: whether only this user and those that it trusts can listen in the folder
        """
        path = estop_path(self.endpoint) if trusted else None
        timeout = ESTOP_SOCKET_TIMEOUT_S
        if path:
            identity, request = self.request(op, args)
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
                client.settimeout(timeout)
                try:
                    client.bind("")  # any free name, as the address of the answer
                    client.connect(os.fspath(path))
                    client.send(request)
                    reply = client.recv(2**20)
                except TimeoutError:
                    timeout = HUNG_TIMEOUT_S
                except OSError:
                    pass
                else:
                    self.estop_taken_by = "estop"
                    return self.result((reply,), identity, kind)
        # Every fishd that this endpoint may mean, by its name.
        daemons = self.find_local_daemons()
        results = self._ask(daemons, kind, op, args, timeout)
        self.silent = [daemon for daemon in daemons if daemon not in results and daemon.is_certain]
        self.estop_taken_by = "kernel" if results else ""
        if results:
            statuses: dict[LocalDaemon, Status] = {}
            with suppress(FishError):
                statuses = self._ask(results, Status, "status", {})
            self._note_detour(results, statuses)
        return next(iter(results.values()), None)

    def ask_directly(self, kind: type[T], op: str, args: Mapping[str, Any]) -> T | None:
        """Send a request to the name of a fishd in the kernel; None without an answer.

        For a fishd whose control socket is gone. Return None also if it may be one of several.
        """
        self.detour = ""
        daemons = self.find_local_daemons()
        statuses = self._ask(daemons, Status, "status", {})
        is_unsure = any(daemon not in statuses and daemon.is_certain for daemon in daemons)
        if is_unsure or len(statuses) != 1:
            return None
        result = next(iter(self._ask(statuses, kind, op, args).values()), None)
        if result is not None:
            self._note_detour(statuses, statuses)
        return result

    def _note_detour(
        self, daemons: "Iterable[LocalDaemon]", statuses: "Mapping[LocalDaemon, Status]"
    ) -> None:
        """Store which of these have answered at their names."""
        from fishd.core import local_daemons

        names = []
        for daemon in daemons:
            status = statuses.get(daemon)
            address = status.control if status else ""
            where = f" at {text.line(address)}" if address not in ("", self.endpoint) else ""
            names.append(local_daemons.format_name(daemon, status) + where)
        place = "their names" if len(names) > 1 else "its name"
        why = "nothing listens at" if self.is_deserted else "no answer from"
        self.detour = (
            f"{why} {self.endpoint}; {' and '.join(names)} answered at {place} in the kernel"
        )

    def _ask(
        self,
        daemons: "Iterable[LocalDaemon]",
        kind: type[T],
        op: str,
        args: Mapping[str, Any],
        timeout: float = ESTOP_SOCKET_TIMEOUT_S,
    ) -> "dict[LocalDaemon, T]":
        """Return the results of those that answer; raise the refusal if all refuse.

        timeout: longest time to wait for all of them [s]
        """
        from fishd.core import local_daemons

        identity, request = self.request(op, args)
        results, refusal = {}, None
        for daemon, reply in local_daemons.ask(daemons, request, timeout).items():
            try:
                result = self.result((reply,), identity, kind)
            except FishError as error:
                refusal = error
            else:
                if result is not None:
                    results[daemon] = result
        if refusal and not results:
            raise refusal
        return results

    def result(self, frames: Sequence[bytes], identity: int, kind: type[T]) -> T | None:
        """Return the result in a reply; None if it answers an earlier request that timed out."""
        reply: protocol.Reply = self.read(protocol.decode_reply, frames)
        if reply.id != identity:
            return None
        if reply.error:
            kind_of_error = LeaseLost if reply.error.code == "no-lease" else Refused
            raise kind_of_error(text.quoted(reply.error.code), text.line(reply.error.message))
        return cast(T, self.read(decoder(kind), (reply.result or b"",)))

    def read(self, decode: Callable[[bytes], T], frames: Sequence[bytes]) -> T:
        """Decode the last frame of a message; raise `FishError` if it is invalid."""
        if self.held:
            self.held.used = time.monotonic()
        try:
            return decode(frames[-1])
        except msgspec.DecodeError as error:
            why = text.line(str(error))
            raise FishError(
                f"the program at {self.endpoint} is not a fishd of this version: {why}"
            ) from None

    def check_lease(self) -> None:
        """Raise `LeaseLost` if the lease of the fish was lost."""
        if self.held and self.held.lost:
            raise self.held.lost

    def with_telemetry(self, status: Status) -> Status:
        """Return a status with the address at which this client gets telemetry."""
        if not self.access:
            return status
        host, port = self.endpoint.rpartition(":")[0], status.keyed_telemetry.rpartition(":")[2]
        return msgspec.structs.replace(status, telemetry=f"{host}:{port}")

    def no_telemetry_error(self, timeout: float) -> NoDaemon:
        """Return the error for missing telemetry of a fishd that does not answer; timeout: [s]."""
        return self._no_daemon(f"no telemetry within {timeout:g} s")


def _find_access(endpoint: str) -> "Access | None":
    if not endpoint.startswith("tcp:"):
        return None
    from fishd.core import keys

    return keys.find_access(endpoint)


def answer_deadlines(seconds: float, *, again: bool) -> Iterator[float]:
    """Yield the deadline of an answer, `seconds` from now, then that of a late one [s, monotonic].

    again: whether to wait for a late answer
    """
    yield time.monotonic() + seconds
    if again:
        yield time.monotonic() + LATE_ANSWER_WAIT_MS * 1e-3
