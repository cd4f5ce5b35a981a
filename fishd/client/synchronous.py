"""`Fish`: the client for ordinary programs."""

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Self, TypeVar

from fishd.client.connection import (
    ESTOP_WAIT_S,
    IDLE_LIMIT,
    SECOND_LOOK,
    TIMEOUT,
    Connection,
    deadlines,
)
from fishd.client.request_socket import RequestSocket
from fishd.core.calibration import ForceCalibration, ForceSample, ServoCalibration
from fishd.core.decoding import decoder
from fishd.core.errors import FishError, LeaseLost, NoDaemon, Untrusted
from fishd.core.protocol import LOADING_TIMEOUT_S, Calibrations, Grant, PolicyInfo, State
from fishd.core.signals import ControllerInfo, Event, Status, Tick

if TYPE_CHECKING:
    import zmq

    from fishd.client.lease import LeaseRenewal

T = TypeVar("T")


class Fish(Connection):
    """A connection to a daemon; use it as a context manager, from one thread.

    Every request raises `NoDaemon` when nobody answers in time, and `Refused` when the daemon
    answers with an error.
    """

    def __init__(
        self, endpoint: str | None = None, *, timeout: float = TIMEOUT, telemetry: str | None = None
    ) -> None:
        """
        endpoint: address of the control socket; None looks for the daemon of this machine
        timeout: how long to wait for an answer or a tick [s]
        telemetry: address of the telemetry socket; None asks the daemon
        """
        super().__init__(endpoint, timeout, telemetry)
        self._socket: RequestSocket | None = None
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        """That of telemetry, with the first subscription."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        if self.held:
            self.held.stop()
        if self._socket:
            self._socket.close()
            self._socket = None
        if self._context:
            self._context.destroy(linger=0)

    def status(self, timeout: float | None = None) -> Status:
        """The daemon in one snapshot.

        timeout: how long to wait for it [s]; None: as for other requests
        """
        patience = 0.0 if timeout is None else timeout - self.timeout
        return self._call(Status, "status", patience=patience)

    def controllers(self) -> list[ControllerInfo]:
        """The controllers that the daemon knows, with their parameters."""
        return self._call(list[ControllerInfo], "controllers")

    def policies(self) -> list[PolicyInfo]:
        """The named policies that the daemon finds, with what their files say about themselves."""
        return self._call(list[PolicyInfo], "policies", patience=LOADING_TIMEOUT_S)

    def config(self) -> dict[str, Any]:
        """The configuration that the daemon was started with, defaults included."""
        return self._call(dict[str, Any], "config")

    def set_controller(self, name: str, /, **parameters: Any) -> State:
        """Select another controller; parameters left out take their defaults.

        It may take `protocol.LOADING_TIMEOUT_S` seconds to load, beyond the time-out.
        """
        return self._call(
            State, "set-controller", patience=LOADING_TIMEOUT_S, name=name, parameters=parameters
        )

    def set_parameters(self, **parameters: Any) -> State:
        """Change parameters of the running controller, all at once or none."""
        return self._call(State, "set-parameter", parameters=parameters)

    def stop(self) -> State:
        """Fade to neutral and stay there."""
        return self._call(State, "stop")

    def estop(
        self, message: str = "requested by a client", *, timeout: float | None = None
    ) -> State:
        """Stop the servo's pulses at once.

        Where the control socket does not answer at once, fishd's own socket is asked as well.

        timeout: how long to wait for an answer, up to 0.5 s for these two not counted [s]; None: as
            for other requests
        """
        try:
            state = self._call(
                State, "estop", patience=ESTOP_WAIT_S - self.timeout, message=message
            )
        except Untrusted:
            raise
        except NoDaemon:
            if answer := self.estop_without_gateway(message):
                return answer
            patience = 0.0 if timeout is None else timeout - self.timeout
            state = self._call(State, "estop", patience=patience, message=message)
        self.estop_taken_by = "control"
        return state

    def clear_fault(self) -> State:
        """Leave mode fault or estop."""
        return self._call(State, "clear-fault")

    def mark(self, text: str) -> State:
        """Publish a mark in the event stream, such as what you just changed on the rig."""
        return self._call(State, "mark", text=text)

    def calibrations(self) -> Calibrations:
        """The calibrations of force sensor and servo that are used."""
        return self._call(Calibrations, "calibrations")

    def sample_force(self, seconds: float = 2.0) -> ForceSample:
        """Measure for a while; refused while a controller other than `hold` is active."""
        return self._call(ForceSample, "sample-force", patience=seconds, seconds=seconds)

    def tare(self, seconds: float = 2.0) -> Calibrations:
        """Measure for a while and call that zero force; refused unless all is still.

        Nothing changes where that is given up while it measures.
        """
        sample = self.sample_force(seconds)
        return self._call(Calibrations, "tare", patience=LOADING_TIMEOUT_S, sample=sample.number)

    def calibrate_force(self, calibration: ForceCalibration) -> Calibrations:
        """Apply another calibration of the force sensor, and save it."""
        return self._call(
            Calibrations, "calibrate-force", patience=LOADING_TIMEOUT_S, calibration=calibration
        )

    def calibrate_servo(self, calibration: ServoCalibration, *, save: bool) -> Calibrations:
        """Apply another calibration of the servo, and save it or not.

        One that is not saved needs a `lease`, and is used until that ends.
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
        idle_limit: float | None = IDLE_LIMIT,
    ) -> "Iterator[LeaseRenewal]":
        """Hold the fish, as an experiment: nobody else drives it, and it rests when this ends.

        Inside, requests of this object name the lease. fishd fades the fish to neutral when this
        process is killed, hangs or loses its connection. `Refused` says who has the fish already;
        `LeaseLost`, from a request or a tick, that another request has taken it meanwhile.

        name: of the experiment, as `fishctl status` shows it
        take: take the fish from an experiment that has it
        seconds: time that the lease lasts without a renewal; None: `control.lease` of fishd
        idle_limit: time without a request or a tick, while the fish swims and this thread does not
            compute, after which the program counts as hung [s]; None for no limit
        """
        from fishd.client.lease import LeaseRenewal, lease_arguments, report_unreturned

        grant = self._call(Grant, "take-lease", **lease_arguments(name, take, seconds))
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
                pass  # another request has the fish, or it rests already
            except FishError as error:
                report_unreturned(error, pending)

    def renew_lease(self, lease: str) -> State:
        """Let a lease last for its full time again, as `lease` does by itself."""
        hurry = -1e-3  # no second look: the next renewal is soon
        return self._call(State, "renew-lease", patience=hurry, lease=lease)

    def end_lease(self, lease: str) -> State:
        """Give the fish back: it fades to neutral."""
        return self._call(State, "end-lease", lease=lease)

    def calibrate_thrust(self, factor: float, error: float) -> State:
        """Let the thrust be shown as this factor times the mean square of `fin_velocity`.

        error: half of its 95 % interval, in its unit
        """
        return self._call(State, "calibrate-thrust", factor=factor, error=error)

    def ticks(self) -> Iterator[Tick]:
        """Every tick from now on; raises `NoDaemon` when none comes in time."""
        return self._subscribe({b"tick": Tick})

    def events(self) -> Iterator[Event]:
        """Every event from now on, however long it takes."""
        return self._subscribe({b"event": Event}, forever=True)

    def ticks_and_events(self) -> Iterator[Tick | Event]:
        """Every tick and event from now on, in the order in which they were published.

        Raises `NoDaemon` when none comes in time.
        """
        kinds: dict[bytes, type[Tick | Event]] = {b"tick": Tick, b"event": Event}
        return self._subscribe(kinds)

    def _call(self, kind: type[T], op: str, *, patience: float = 0.0, **args: Any) -> T:
        """Ask; patience: how long the answer may take, beyond the time-out [s].

        Where it is negative, the caller is in a hurry, and there is no second look.
        """
        if self._socket is None:
            self.check_endpoint()
            self._socket = RequestSocket(self.endpoint)
        identity, request = self.request(op, args)
        for deadline in deadlines(self.timeout + patience, again=patience >= 0.0):
            if request and self._socket.send_by(deadline, request):
                request = b""
            while not request and (reply := self._socket.receive_by(deadline)):
                result = self.result((reply,), identity, kind)
                if result is not None:
                    return result
        raise self.silent(patience)

    def _subscribe(self, kinds: dict[bytes, type[T]], *, forever: bool = False) -> Iterator[T]:
        """Messages of these topics; forever: however long they take."""
        address = self.telemetry_address or self.status().telemetry
        patience = -1 if forever else int(self.timeout * 1e3)
        decoders = {topic: decoder(kind) for topic, kind in kinds.items()}
        import zmq

        from fishd.client.zmq_sockets import subscriber

        self._context = self._context or zmq.Context()
        socket = subscriber(self._context, address, *kinds)

        def messages() -> Iterator[T]:
            with closing(socket):
                while socket.poll(patience) or socket.poll(SECOND_LOOK):
                    self.check_lease()
                    frames = socket.recv_multipart()
                    if decode := decoders.get(frames[0]):
                        yield self.read(decode, frames)
            raise self.telemetry_silent()

        return messages()
