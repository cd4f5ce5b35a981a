"""`AsyncFish`: the client for asyncio programs."""

import asyncio
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from functools import partial
from typing import Any, Self, TypeVar

import zmq.asyncio

from fishd.client.connection import (
    DEFAULT_IDLE_LIMIT_S,
    DEFAULT_TIMEOUT_S,
    ESTOP_FALLBACK_DELAY_S,
    LATE_ANSWER_WAIT_MS,
    Connection,
    answer_deadlines,
)
from fishd.client.lease import LeaseRenewal, lease_arguments, report_unreturned
from fishd.client.synchronous import Fish
from fishd.client.zmq_sockets import connect_dealer, connect_subscriber, milliseconds_until
from fishd.core.calibration import ForceCalibration, ForceSample, ServoCalibration
from fishd.core.decoding import decoder
from fishd.core.errors import FishError, LeaseLost, NoDaemon, Untrusted
from fishd.core.protocol import LOADING_TIMEOUT_S, Calibrations, Grant, PolicyInfo, State
from fishd.core.signals import ControllerInfo, Event, Status, Tick

T = TypeVar("T")


class AsyncFish(Connection):
    """`Fish` for asyncio: the same requests, to be awaited; `Fish` has more details on each."""

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        timeout: float = DEFAULT_TIMEOUT_S,
        telemetry: str | None = None,
    ) -> None:
        """The arguments are those of `Fish`."""
        super().__init__(endpoint, timeout, telemetry)
        self._context = zmq.asyncio.Context()
        self._socket: zmq.asyncio.Socket | None = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        if self.held:
            self.held.stop()
        self._context.destroy(linger=0)

    async def status(self) -> Status:
        """Return a snapshot of the daemon."""
        return await self._call(Status, "status")

    async def controllers(self) -> list[ControllerInfo]:
        """Return the controllers of the daemon, with their parameters."""
        return await self._call(list[ControllerInfo], "controllers")

    async def policies(self) -> list[PolicyInfo]:
        """Return the named policies that the daemon finds, with the metadata of their files."""
        return await self._call(list[PolicyInfo], "policies", patience=LOADING_TIMEOUT_S)

    async def config(self) -> dict[str, Any]:
        """Return the configuration that the daemon was started with, defaults included."""
        return await self._call(dict[str, Any], "config")

    async def set_controller(self, name: str, /, **parameters: Any) -> State:
        """Activate a controller; omitted parameters take their defaults."""
        return await self._call(
            State, "set-controller", patience=LOADING_TIMEOUT_S, name=name, parameters=parameters
        )

    async def set_parameters(self, **parameters: Any) -> State:
        """Change parameters of the active controller, all at once or none."""
        return await self._call(State, "set-parameter", parameters=parameters)

    async def stop(self) -> State:
        """Fade to neutral and stay there."""
        return await self._call(State, "stop")

    async def estop(self, message: str = "requested by a client") -> State:
        """Stop the servo's pulses at once, like `Fish.estop`."""
        try:
            state = await self._call(
                State, "estop", patience=ESTOP_FALLBACK_DELAY_S - self.timeout, message=message
            )
        except Untrusted:
            raise
        except NoDaemon:
            if answer := await asyncio.to_thread(self.estop_without_gateway, message):
                return answer
            state = await self._call(State, "estop", message=message)
        self.estop_taken_by = "control"
        return state

    async def clear_fault(self) -> State:
        """Leave mode fault or estop."""
        return await self._call(State, "clear-fault")

    async def mark(self, text: str) -> State:
        """Publish a mark in the event stream."""
        return await self._call(State, "mark", text=text)

    async def calibrations(self) -> Calibrations:
        """Return the active calibrations of force sensor and servo."""
        return await self._call(Calibrations, "calibrations")

    async def sample_force(self, seconds: float = 2.0) -> ForceSample:
        """Measure for this time [s]; refused while a controller other than `hold` is active."""
        return await self._call(ForceSample, "sample-force", patience=seconds, seconds=seconds)

    async def tare(self, seconds: float = 2.0) -> Calibrations:
        """Measure for this time [s] and set the mean as zero force; refused unless all is still."""
        sample = await self.sample_force(seconds)
        return await self._call(
            Calibrations, "tare", patience=LOADING_TIMEOUT_S, sample=sample.number
        )

    async def calibrate_force(self, calibration: ForceCalibration) -> Calibrations:
        """Apply and save a calibration of the force sensor."""
        return await self._call(
            Calibrations, "calibrate-force", patience=LOADING_TIMEOUT_S, calibration=calibration
        )

    async def calibrate_thrust(self, factor: float, error: float) -> State:
        """Set the factor of the displayed thrust, like `Fish.calibrate_thrust`."""
        return await self._call(State, "calibrate-thrust", factor=factor, error=error)

    async def calibrate_servo(self, calibration: ServoCalibration, *, save: bool) -> Calibrations:
        """Apply a calibration of the servo, and save it if requested."""
        return await self._call(
            Calibrations,
            "calibrate-servo",
            patience=LOADING_TIMEOUT_S if save else 0.0,
            calibration=calibration,
            save=save,
        )

    @asynccontextmanager
    async def lease(
        self,
        name: str,
        take: bool = False,
        *,
        seconds: float | None = None,
        idle_limit: float | None = DEFAULT_IDLE_LIMIT_S,
    ) -> AsyncIterator[LeaseRenewal]:
        """Hold the lease of the fish, like `Fish.lease`."""
        grant = await self._call(Grant, "take-lease", **lease_arguments(name, take, seconds))
        self.held = renewal = LeaseRenewal(partial(Fish, self.endpoint), grant, idle_limit)
        try:
            yield renewal
        finally:
            pending, self.held = sys.exception(), None
            await asyncio.to_thread(renewal.stop)
            try:
                if not renewal.returned:
                    await self._call(State, "end-lease", lease=renewal.token)
            except LeaseLost:
                pass
            except FishError as error:
                report_unreturned(error, pending)

    def ticks(self) -> AsyncIterator[Tick]:
        """Yield every tick from the first iteration on; raise `NoDaemon` if none comes in time."""
        return self._subscribe(b"tick", Tick)

    def events(self) -> AsyncIterator[Event]:
        """Yield every event from the first iteration on; wait without limit."""
        return self._subscribe(b"event", Event)

    async def _call(self, kind: type[T], op: str, *, patience: float = 0.0, **args: Any) -> T:
        """Send a request and return its result; tasks that share this object must take turns.

        patience: time that the answer may take in addition to the timeout [s]
        """
        if self._socket is None:
            self.check_endpoint()
            self._socket = connect_dealer(self._context, self.endpoint)
        identity, request = self.request(op, args)
        poll_event = zmq.POLLOUT
        for deadline in answer_deadlines(self.timeout + patience, again=patience >= 0.0):
            while await self._socket.poll(
                milliseconds_until(deadline),
                poll_event,  # type: ignore[call-arg]  # which the stubs forget
            ):
                if poll_event == zmq.POLLOUT:
                    await self._socket.send(request)
                    poll_event = zmq.POLLIN
                    continue
                frames = await self._socket.recv_multipart()
                result = self.result(frames, identity, kind)
                if result is not None:
                    return result
        raise self.no_answer_error(patience)

    async def _subscribe(self, topic: bytes, kind: type[T]) -> AsyncIterator[T]:
        address = self.telemetry_address or (await self.status()).telemetry
        patience = -1 if kind is Event else int(self.timeout * 1e3)
        decode: Callable[[bytes], T] = decoder(kind)
        with closing(connect_subscriber(self._context, address, topic)) as socket:
            while await socket.poll(patience) or await socket.poll(LATE_ANSWER_WAIT_MS):
                self.check_lease()
                yield self.read(decode, await socket.recv_multipart())
        raise self.no_telemetry_error()
