"""`Fish`: the client for synchronous programs."""

import math
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Self, TypeVar

from msgspec import UNSET, UnsetType

from fishd.client.connection import (
    DEFAULT_IDLE_LIMIT_S,
    DEFAULT_TIMEOUT_S,
    ESTOP_FALLBACK_DELAY_S,
    LATE_ANSWER_WAIT_MS,
    Connection,
    answer_deadlines,
)
from fishd.client.request_socket import MAX_UNANSWERED_S, Requester, Requests, RequestSocket
from fishd.core.calibration import ForceCalibration, ForceSample, ServoCalibration
from fishd.core.decoding import decoder
from fishd.core.errors import FishError, LeaseLost, NoDaemon, NoKey, Refused, Untrusted
from fishd.core.protocol import (
    DIRECT_OPERATIONS,
    LOADING_TIMEOUT_S,
    READ_OPERATIONS,
    Calibrations,
    Grant,
    PolicyInfo,
    State,
)
from fishd.core.signals import ControllerInfo, Event, Status, Tick

if TYPE_CHECKING:
    import zmq

    from fishd.client.lease import LeaseRenewal
    from fishd.core.keys import Access

T = TypeVar("T")


class Fish(Connection):
    """Connection to a daemon; use it as a context manager, from one thread.

    Every request raises `NoDaemon` if no answer comes in time or the connection is lost before, and
    `Refused` if the daemon answers with an error.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        timeout: float = DEFAULT_TIMEOUT_S,
        telemetry: str | None = None,
        access: "Access | UnsetType | None" = UNSET,
    ) -> None:
        """
        endpoint: address of the control socket; None for the daemon of this machine
        timeout: time to wait for an answer or a tick [s]
        telemetry: address of the telemetry socket; None for the address that the daemon reports
        access: keys for this endpoint, None for none; read from their folder by default
        """
        super().__init__(endpoint, timeout, telemetry, access)
        self._requester = Requester(self._open_socket, forgettable=not self._path)
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        """ZeroMQ context of telemetry, created by the first subscription."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def interrupt(self) -> None:
        """End the request of another thread, which then raises `FishError`."""
        self._requester.interrupt()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        if self.held:
            self.held.stop()
        self._requester.disconnect()
        if self._context:
            self._context.destroy(linger=0)

    def status(self, timeout: float | None = None) -> Status:
        """Return a snapshot of the daemon.

        timeout: time to wait for it [s]; None for that of other requests
        """
        patience = 0.0 if timeout is None else timeout - self.timeout
        return self.with_telemetry(self._call(Status, "status", patience=patience))

    def controllers(self) -> list[ControllerInfo]:
        """Return the controllers of the daemon, with their parameters."""
        return self._call(list[ControllerInfo], "controllers")

    def policies(self) -> list[PolicyInfo]:
        """Return the named policies that the daemon finds, with the metadata of their files."""
        return self._call(list[PolicyInfo], "policies", patience=LOADING_TIMEOUT_S)

    def config(self) -> dict[str, Any]:
        """Return the configuration that the daemon was started with, defaults included."""
        return self._call(dict[str, Any], "config")

    def set_controller(self, name: str, /, **parameters: Any) -> State:
        """Activate a controller; omitted parameters take their defaults.

        It may take `protocol.LOADING_TIMEOUT_S` to load, in addition to the timeout.
        """
        return self._call(
            State, "set-controller", patience=LOADING_TIMEOUT_S, name=name, parameters=parameters
        )

    def set_parameters(self, /, **parameters: Any) -> State:
        """Change parameters of the active controller, all at once or none."""
        return self._call(State, "set-parameter", parameters=parameters)

    def stop(self) -> State:
        """Fade to neutral and stay there."""
        return self._call(State, "stop")

    def estop(
        self, message: str = "requested by a client", *, timeout: float | None = None
    ) -> State:
        """Stop the servo's pulses at once.

        If the control socket does not answer at once, the request goes to fishd's own sockets, too.

        timeout: time to wait for an answer after these first attempts, which take up to 0.5 s [s];
            None for that of other requests
        """
        return self._call_urgently(State, "estop", timeout, message=message)

    def probe_estop(self) -> Status:
        """Return the status by the path of `estop`, or raise what that would raise."""
        return self._call_urgently(Status, "status", None)

    def _call_urgently(self, kind: type[T], op: str, timeout: float | None, **args: Any) -> T:
        """Do as `estop` for an operation that all of fishd's sockets take."""
        if self.is_deserted and (answer := self.ask_without_gateway(kind, op, args)):
            return answer
        try:
            result = self._ask_gateway(kind, op, ESTOP_FALLBACK_DELAY_S - self.timeout, args)
        except Refused:
            raise
        except FishError as error:  # such as NoDaemon, or for another program in its place
            is_trusted = not isinstance(error, Untrusted)
            if answer := self.ask_without_gateway(kind, op, args, trusted=is_trusted):
                return answer
            if not is_trusted:
                raise
            patience = 0.0 if timeout is None else timeout - self.timeout
            result = self._ask_gateway(kind, op, patience, args)
        self.estop_taken_by = "control"
        return result

    def clear_fault(self) -> State:
        """Leave mode fault or estop."""
        return self._call(State, "clear-fault")

    def restart(self) -> State:
        """Let systemd restart fishd, which then reads its configuration again; raise `Refused`."""
        return self._call(State, "restart", patience=LOADING_TIMEOUT_S)

    def mark(self, text: str) -> State:
        """Publish a mark in the event stream, such as a note on a change of the rig."""
        return self._call(State, "mark", text=text)

    def calibrations(self) -> Calibrations:
        """Return the active calibrations of force sensor and servo."""
        return self._call(Calibrations, "calibrations")

    def sample_force(self, seconds: float = 2.0) -> ForceSample:
        """Measure for this time [s]; refused while a controller other than `hold` is active."""
        return self._call(ForceSample, "sample-force", patience=seconds, seconds=seconds)

    def tare(self, seconds: float = 2.0) -> Calibrations:
        """Measure for this time [s] and set the mean as zero force; refused unless all is still.

        Nothing changes if the program is interrupted during the measurement.
        """
        sample = self.sample_force(seconds)
        return self._call(Calibrations, "tare", patience=LOADING_TIMEOUT_S, sample=sample.number)

    def calibrate_force(self, calibration: ForceCalibration) -> Calibrations:
        """Apply and save a calibration of the force sensor."""
        return self._call(
            Calibrations, "calibrate-force", patience=LOADING_TIMEOUT_S, calibration=calibration
        )

    def calibrate_servo(self, calibration: ServoCalibration, *, save: bool) -> Calibrations:
        """Apply a calibration of the servo, and save it if requested.

        A calibration that is not saved needs a `lease`, and is active until that ends.
        """
        return self._call(
            Calibrations,
            "calibrate-servo",
            patience=LOADING_TIMEOUT_S if save else 0.0,
            calibration=calibration,
            save=save,
        )

    @contextmanager
    def lease(
        self,
        name: str,
        take: bool = False,
        *,
        seconds: float | None = None,
        idle_limit: float | None = DEFAULT_IDLE_LIMIT_S,
    ) -> "Iterator[LeaseRenewal]":
        """Hold the lease of the fish: no other client drives it, and it rests at the end.

        Inside, requests of this object name the lease. fishd fades the fish to neutral if this
        process is killed, hangs or loses its connection. Raise `Refused` if another experiment
        holds the fish; requests and ticks raise `LeaseLost` if another request has taken it since.

        name: name of the experiment, as `fishctl status` shows it
        take: take the fish from an experiment that holds it
        seconds: duration of the lease without a renewal; None for `control.lease` of fishd
        idle_limit: time without a request or a tick, while the fish swims and this thread does not
            compute, after which the program counts as hung [s]; None for no limit
        """
        from fishd.client.lease import LeaseRenewal, report_unreturned

        grant = self.take_lease(name, take, seconds)
        connect = partial(Fish, self.endpoint)
        self.held = renewal = LeaseRenewal(connect, grant, idle_limit)
        try:
            yield renewal
        finally:
            pending, self.held = sys.exception(), None
            renewal.stop()
            try:
                if not renewal.returned:
                    self.end_lease(renewal.token)
            except LeaseLost:
                pass  # another request has taken the fish, or it rests already
            except FishError as error:
                report_unreturned(error, pending)

    def take_lease(self, name: str, take: bool, seconds: float | None) -> Grant:
        """Take the lease of the fish without renewing it; `lease` has these arguments, too."""
        from fishd.client.lease import lease_arguments

        return self._call(Grant, "take-lease", **lease_arguments(name, take, seconds))

    def renew_lease(self, lease: str) -> State:
        """Restart the full duration of a lease; `lease` does so automatically."""
        hurry = -1e-3  # do not wait for a late answer: the next renewal is soon
        return self._call(State, "renew-lease", patience=hurry, lease=lease)

    def end_lease(self, lease: str) -> State:
        """Return the fish, which fades to neutral."""
        return self._call(State, "end-lease", lease=lease)

    def calibrate_thrust(self, factor: float, factor_ci95: float) -> State:
        """Set the ratio of the displayed thrust to the mean square of `fin_velocity` [N].

        factor_ci95: half-width of the 95 % confidence interval of `factor` [N]
        """
        return self._call(State, "calibrate-thrust", factor=factor, factor_ci95=factor_ci95)

    def ticks(self) -> Iterator[Tick]:
        """Return an iterator of all ticks from now on; it raises `NoDaemon` after a silence."""
        return self._subscribe({b"tick": Tick})

    def events(self) -> Iterator[Event]:
        """Return an iterator of all events from now on, which waits without limit."""
        return self._subscribe({b"event": Event}, forever=True)

    def ticks_and_events(self) -> Iterator[Tick | Event]:
        """Return an iterator of all ticks and events from now on, in the order of publication.

        It raises `NoDaemon` if none comes in time.
        """
        kinds: dict[bytes, type[Tick | Event]] = {b"tick": Tick, b"event": Event}
        return self._subscribe(kinds)

    def _call(self, kind: type[T], op: str, *, patience: float = 0.0, **args: Any) -> T:
        """Send a request and return its result; send a read again on a new connection.

        patience: time that the answer may take in addition to the timeout; negative to wait for no
            late answer [s]
        """
        try:
            return self._ask_gateway(kind, op, patience, args)
        except NoDaemon:
            # The file of its socket may be gone, or another program may listen in its place.
            can_ask = self._path and op in DIRECT_OPERATIONS
            if can_ask and (result := self.ask_directly(kind, op, args)) is not None:
                return result
            raise

    def _ask_gateway(self, kind: type[T], op: str, patience: float, args: dict[str, Any]) -> T:
        """Do as `_call`, through the control socket alone."""
        try:
            return self._exchange(kind, op, patience, args)
        except NoKey:  # the next request connects again
            self._requester.disconnect()
            raise

    def _exchange(self, kind: type[T], op: str, patience: float, args: dict[str, Any]) -> T:
        identity, request = self.request(op, args)
        deadlines = answer_deadlines(self.timeout + patience, again=patience >= 0.0)

        def read(reply: bytes) -> T | None:
            return self.result((reply,), identity, kind)

        try:
            result = self._requester.exchange(request, read, deadlines, op in READ_OPERATIONS)
        except ConnectionResetError:
            raise self.lost_command_error(op) from None
        if result is None:
            raise self.no_answer_error(patience)
        return result

    def _open_socket(self) -> Requests:
        self.check_endpoint()
        if not self.access:
            return RequestSocket(self.endpoint)
        from fishd.client.keyed_socket import KeyedRequestSocket

        return KeyedRequestSocket(self.endpoint, self.access)

    def _subscribe(self, kinds: dict[bytes, type[T]], *, forever: bool = False) -> Iterator[T]:
        """Return an iterator of the messages of these topics; forever: wait without limit."""
        import zmq

        from fishd.client.zmq_sockets import TelemetryReader, connect_subscriber

        self._context = context = self._context or zmq.Context()

        def connect(address: str) -> "zmq.Socket[bytes]":
            return connect_subscriber(context, address, *kinds, access=self.access)

        address = self.telemetry_address or self.status().telemetry
        reader = TelemetryReader(self, connect, address, math.inf if forever else self.timeout)
        decoders = {topic: decoder(kind) for topic, kind in kinds.items()}

        def messages() -> Iterator[T]:
            with closing(reader):
                reader.expect_next()
                while True:
                    if not reader.socket.poll(reader.wait_ms):
                        address = self.find_telemetry()
                        if not reader.socket.poll(LATE_ANSWER_WAIT_MS):
                            reader.handle_silence(address)
                        continue
                    self.check_lease()
                    frames = reader.socket.recv_multipart()
                    reader.hear()
                    if decode := decoders.get(frames[0]):
                        yield self.read(decode, frames)
                        reader.expect_next()
                    else:
                        reader.check_ticks()

        return messages()

    def find_telemetry(self) -> str:
        """Return the present address of telemetry; empty without an answer.

        Raise an error if the key of this client is no longer known.
        """
        for _ in range(2):
            try:
                status = self.status(min(self.timeout, MAX_UNANSWERED_S))
            except NoDaemon:
                if self._path:
                    break
                self._requester.disconnect()  # a router may have forgotten this connection, too
            else:
                return self.telemetry_address or status.telemetry
        return ""
