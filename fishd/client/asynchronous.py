"""`AsyncFish`: the client for asyncio programs."""

import asyncio
import functools
import math
import sys
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, closing
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Self, TypeVar

import zmq.asyncio

from fishd.client.connection import DEFAULT_IDLE_LIMIT_S, DEFAULT_TIMEOUT_S, LATE_ANSWER_WAIT_MS
from fishd.client.lease import LeaseRenewal, report_unreturned
from fishd.client.synchronous import Fish
from fishd.client.zmq_sockets import TelemetryReader, connect_subscriber
from fishd.core.decoding import decoder
from fishd.core.errors import FishError, LeaseLost
from fishd.core.protocol import State
from fishd.core.signals import Event, Status, Tick

if TYPE_CHECKING:
    from fishd.core.keys import Access

P = ParamSpec("P")
T = TypeVar("T")


def _run_in_thread(
    method: Callable[Concatenate[Fish, P], T],
) -> Callable[Concatenate["AsyncFish", P], Coroutine[Any, Any, T]]:
    """Return a method of `AsyncFish` that runs one of `Fish` in a thread."""

    async def call(self: "AsyncFish", /, *args: P.args, **kwargs: P.kwargs) -> T:
        def run() -> T:
            with self._lock:
                return method(self._fish, *args, **kwargs)

        return await asyncio.to_thread(run)

    functools.update_wrapper(call, method)
    return call


class AsyncFish:
    """`Fish` for asyncio: the same requests, to be awaited; those of several tasks take turns.

    A request whose task is cancelled ends in its thread.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        timeout: float = DEFAULT_TIMEOUT_S,
        telemetry: str | None = None,
    ) -> None:
        """The arguments are those of `Fish`."""
        self._fish = Fish(endpoint, timeout=timeout, telemetry=telemetry)
        self._lock = threading.Lock()
        self._context = zmq.asyncio.Context()

    @property
    def access(self) -> "Access | None":
        """Keys of this client and of the fishd, as in `Fish`."""
        return self._fish.access

    def with_telemetry(self, status: Status) -> Status:
        """Return a status with the address at which this client gets telemetry."""
        return self._fish.with_telemetry(status)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect, without waiting for the answers of requests; may be called twice."""
        self._fish.interrupt()
        with self._lock:
            self._fish.close()
        self._context.destroy(linger=0)

    status = _run_in_thread(Fish.status)
    controllers = _run_in_thread(Fish.controllers)
    policies = _run_in_thread(Fish.policies)
    config = _run_in_thread(Fish.config)
    set_controller = _run_in_thread(Fish.set_controller)
    set_parameters = _run_in_thread(Fish.set_parameters)
    stop = _run_in_thread(Fish.stop)
    clear_fault = _run_in_thread(Fish.clear_fault)
    restart = _run_in_thread(Fish.restart)
    mark = _run_in_thread(Fish.mark)
    calibrations = _run_in_thread(Fish.calibrations)
    sample_force = _run_in_thread(Fish.sample_force)
    tare = _run_in_thread(Fish.tare)
    calibrate_force = _run_in_thread(Fish.calibrate_force)
    calibrate_thrust = _run_in_thread(Fish.calibrate_thrust)
    calibrate_servo = _run_in_thread(Fish.calibrate_servo)
    _take_lease = _run_in_thread(Fish.take_lease)
    end_lease = _run_in_thread(Fish.end_lease)
    _find_telemetry = _run_in_thread(Fish.find_telemetry)

    async def estop(self, message: str = "requested by a client") -> State:
        """Stop the servo's pulses at once, like `Fish.estop`, before requests that wait."""

        def stop() -> State:
            with Fish(self._fish.endpoint, timeout=self._fish.timeout) as fish:
                return fish.estop(message)

        return await asyncio.to_thread(stop)

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
        grant = await self._take_lease(name, take, seconds)
        connect = functools.partial(Fish, self._fish.endpoint)
        self._fish.held = renewal = LeaseRenewal(connect, grant, idle_limit)
        try:
            yield renewal
        finally:
            pending, self._fish.held = sys.exception(), None
            await asyncio.to_thread(renewal.stop)
            try:
                if not renewal.returned:
                    await self.end_lease(renewal.token)
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

    async def _subscribe(self, topic: bytes, kind: type[T]) -> AsyncIterator[T]:
        fish = self._fish

        def connect(address: str) -> zmq.asyncio.Socket:
            return connect_subscriber(self._context, address, topic, access=fish.access)

        address = fish.telemetry_address or (await self.status()).telemetry
        reader = TelemetryReader(
            fish, connect, address, math.inf if kind is Event else fish.timeout
        )
        decode: Callable[[bytes], T] = decoder(kind)
        with closing(reader):
            while True:
                if not await reader.socket.poll(reader.wait_ms):
                    address = await self._find_telemetry()
                    if not await reader.socket.poll(LATE_ANSWER_WAIT_MS):
                        reader.handle_silence(address)
                    continue
                fish.check_lease()
                frames = await reader.socket.recv_multipart()
                reader.hear()
                if frames[0] == topic:
                    yield fish.read(decode, frames)
                    reader.expect_next()
                else:
                    reader.check_ticks()
