"""Link to one fish: its telemetry, the state of the connection, and requests."""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AsyncExitStack, closing, contextmanager, suppress
from typing import Any, NamedTuple

import msgspec
import zmq.asyncio
from msgspec import UNSET, Struct

from fishd.client import AsyncFish
from fishd.client.lease import LeaseRenewal
from fishd.client.zmq_sockets import Subscription, connect_subscriber
from fishd.core import text
from fishd.core.addresses import find_control_address
from fishd.core.decoding import decoder
from fishd.core.errors import FishError, LeaseLost, Refused
from fishd.core.protocol import Calibrations, PolicyInfo
from fishd.core.signals import ControllerInfo, Event, Status, Tick
from fishd.window.estop_path import EstopPath
from fishd.window.live import encode_message
from fishd.window.past import Past

log = logging.getLogger(__name__)

MAX_TICKS = 2400
"""Number of ticks in the history for a page that opens; it bounds memory, whatever the tick."""
HISTORY_AGE_S = 1.0
"""Longest age of the encoded history that is sent again [s]."""
PART_TICKS = 200
"""Number of ticks in a part of the history: of a long message, each slow page kept a copy."""
MAX_EVENTS = 100
STALE_AFTER_S = 0.7
"""Time without a tick after which the fish counts as stale [s]."""
PROBE_PERIOD_S = 1.0
"""Time between two requests for the status of a fish that sends no ticks [s]."""
PROBE_TIMEOUT_S = 1.0
"""Longest wait for that status [s]."""
BATCH_PERIOD_S = 0.05
"""Shortest time between two messages with ticks [s]."""
MAX_WAITING_REQUESTS = 8
"""Number of requests above which a further one is refused."""
_decode_tick: Callable[[bytes], Tick] = decoder(Tick)
_decode_event: Callable[[bytes], Event] = decoder(Event)
_decode_status: Callable[[bytes], Status] = decoder(Status)
_OPTIONAL = {field.name for field in msgspec.structs.fields(Tick) if field.default is UNSET}
"""Fields that a tick may lack."""
_RAW = msgspec.json.Encoder().encode


class Connection(Struct, frozen=True):
    """State of the connection to a fish."""

    state: str
    """`live`, `stale`, `lost` or `restarted`."""
    age: float
    """Time since the last tick [s]."""
    message: str
    warning: str
    """Why an emergency stop may not reach the fish; empty if its path answers."""


class Busy(FishError):
    """Too many requests wait."""


class FishLink:
    """Link to one fish; `run` follows it until it is cancelled."""

    def __init__(self, name: str, endpoint: str | None, tell: Callable[[str, bytes], None]) -> None:
        """
        name: name of the fish in the page
        endpoint: its control socket; None for the fishd of this machine
        tell: receives each message for the pages: its type, and its payload as JSON
        """
        self.name, self.endpoint = name, endpoint
        self.status: Status | None = None
        self.controllers: list[ControllerInfo] = []
        self.events: deque[bytes] = deque(maxlen=MAX_EVENTS)
        self._ticks: deque[tuple[int, bytes]] = deque(maxlen=MAX_TICKS)
        """Number and payload of each tick of the history."""
        self._past = Past()
        self._history: tuple[float, int, list[bytes]] = (-HISTORY_AGE_S, 0, [])
        """When the history was encoded [s, monotonic], its last tick, and its messages."""
        self.listeners: set[Callable[[str, float, bytes], None]] = set()
        """Functions that receive topic, time [s] and payload of each message.

        The time begins as unix time; no later step of the unix clock moves it.
        """
        self._ahead: float | None = None
        """Unix time minus monotonic time of the first message of this fishd [s]."""
        self._tell = tell
        self._fish = AsyncFish(endpoint)
        self._stopper = AsyncFish(endpoint)
        self._monitor = AsyncFish(endpoint, timeout=PROBE_TIMEOUT_S)
        self.estop_path = EstopPath(name, endpoint, self._fish.access)
        self._context = zmq.asyncio.Context()
        self._batch: list[bytes] = []
        self._flush: asyncio.TimerHandle | None = None
        self._next_flush = self._last_tick = self._next_probe = 0.0
        self._started = time.monotonic()
        self._seq = 0
        self._state, self._message = "lost", "connecting"
        self._waiting = 0
        self._taking = asyncio.Lock()
        self._lease: _HeldLease | None = None

    async def close(self) -> None:
        """Return the fish, and disconnect."""
        await self.give_back()
        for fish in (self._fish, self._stopper, self._monitor):
            fish.close()
        self._context.destroy(linger=0)
        self.estop_path.close()

    @property
    def connection(self) -> Connection:
        """State of the connection."""
        age = time.monotonic() - (self._last_tick or self._started)
        return Connection(self._state, round(age, 2), self._message, self.estop_path.warning)

    @property
    def is_heard(self) -> bool:
        """Whether ticks arrive, so that `status` is not old."""
        return self.status is not None and self._state not in ("stale", "lost")

    @property
    def endpoint_options(self) -> list[str]:
        """Options of fishctl for this fish."""
        return [] if self.endpoint is None else ["--endpoint", self.endpoint]

    @property
    def address(self) -> str:
        """Control socket of the fish."""
        return self.endpoint or find_control_address()

    # Telemetry

    async def run(self) -> None:
        """Follow the fish, also after it restarts, until this task is cancelled."""
        await asyncio.gather(self.estop_path.watch(), self._follow_on())

    async def _follow_on(self) -> None:
        while True:
            try:
                await self._follow()
            except FishError as error:
                self._set_connection("lost", str(error))
            except Exception as error:
                message = f"a mistake in fishd-window: {text.describe_error(error)}"
                log.error("%s", message, exc_info=True)
                self._set_connection("lost", message)
            await asyncio.sleep(PROBE_PERIOD_S)

    async def _follow(self) -> None:
        """Read telemetry until its address changes; raise `FishError`."""
        status = await self._take_status(await self._monitor.status())
        if self._state != "restarted":
            self._set_connection("stale", "no tick has come yet")
        address = status.telemetry

        def connect(address: str) -> zmq.asyncio.Socket:
            topics, access = (b"tick", b"event"), self._fish.access
            return connect_subscriber(self._context, address, *topics, access=access)

        telemetry = Subscription(connect, address, f"the fishd at {self.address}")
        with closing(telemetry):
            while self.status and self.status.telemetry == address:
                if await telemetry.socket.poll(int(STALE_AFTER_S * 1e3)):
                    frames = await telemetry.socket.recv_multipart()
                    telemetry.hear()
                    await self._receive(frames)
                elif telemetry.is_dead():
                    telemetry.replace(address)
                if time.monotonic() - self._last_tick > STALE_AFTER_S:
                    await self._probe()

    async def _receive(self, frames: list[bytes]) -> None:
        try:
            if frames[0] == b"tick":
                tick = _decode_tick(frames[-1])
                self._receive_tick(tick, frames[-1])
                self._pass_on("tick", tick.t, tick.time, frames[-1])
            elif frames[0] == b"event":
                event = _decode_event(frames[-1])
                self.events.append(frames[-1])
                self._tell("event", frames[-1])
                self._pass_on("event", event.t, event.time, frames[-1])
            elif frames[0] == b"status":
                status = await self._take_status(
                    self._fish.with_telemetry(_decode_status(frames[-1]))
                )
                self._pass_on("status", status.t, status.clock, frames[-1])
        except msgspec.DecodeError as error:
            raise FishError(
                f"the program at {self.address} is not a fishd of this version: "
                f"{text.error_message(error)}"
            ) from None

    def _pass_on(self, topic: str, t: float, time: float, payload: bytes) -> None:
        """Give a message to the listeners; t, time: its unix and monotonic time [s]."""
        if self._ahead is None:
            self._ahead = t - time
        for listener in self.listeners:
            listener(topic, time + self._ahead if time else t, payload)

    def _receive_tick(self, tick: Tick, payload: bytes) -> None:
        now = self._last_tick = time.monotonic()
        if tick.seq <= self._seq:
            self._forget()
        self._seq = tick.seq
        self._ticks.append((tick.seq, payload))
        self._past.add(tick)
        if self._state in ("stale", "lost"):
            self._set_connection("live", "")
        self._batch.append(payload)
        if now >= self._next_flush:
            self.flush()
        elif not self._flush:
            delay = self._next_flush - now
            self._flush = asyncio.get_running_loop().call_later(delay, self.flush)

    def flush(self) -> None:
        """Send the ticks that wait; first do so where a page gets the history, which has them."""
        self._next_flush = time.monotonic() + 0.9 * BATCH_PERIOD_S
        if self._flush:
            self._flush.cancel()
            self._flush = None
        batch, self._batch = self._batch, []
        if batch:
            self._tell("ticks", b"[" + b",".join(batch) + b"]")

    async def _take_status(self, status: Status) -> Status:
        """Store a status; after a restart of fishd, begin again.

        Where a new fishd does not list its controllers, its next status counts as its first.
        """
        before = self.status
        if (
            before
            and status.pid == before.pid
            and status.uptime < before.uptime
            and status.t < before.t
        ):
            return before  # this telemetry was overtaken by the answer to a probe
        restarted = before is not None and status.shows_restart_since(before)
        if before is None or restarted:
            self.controllers = await self._monitor.controllers()
        self.status = status
        if restarted:
            self._forget()
            self._set_connection("restarted", f"fishd has restarted: it is process {status.pid}")
            self._tell("hello", b"")
        elif self._state == "restarted":
            self._set_connection("live", "")
        elif before is None:
            self._tell("hello", b"")
        self._tell("status", _RAW(status))
        return status

    def _forget(self) -> None:
        """Forget the ticks of an earlier fishd."""
        self._ticks.clear()
        self._past.clear()
        self._history = (-HISTORY_AGE_S, 0, [])
        self._batch.clear()
        self._seq = 0
        self._ahead = None

    async def _probe(self) -> None:
        """Find out why no ticks come; raise `NoDaemon` if fishd does not answer."""
        age = time.monotonic() - (self._last_tick or self._started)
        self._set_connection("stale", f"no tick for {age:.1f} s")
        if time.monotonic() >= self._next_probe:
            self._next_probe = time.monotonic() + PROBE_PERIOD_S
            await self._take_status(await self._monitor.status())

    def _set_connection(self, state: str, message: str) -> None:
        self._state, self._message = state, text.line(message)
        self._tell("connection", _RAW(self.connection))

    def history(self) -> tuple[list[bytes], bytes]:
        """Return the history as messages for pages, shared by all within a second, and later ticks.

        First come the extremes of ten minutes, then the latest ticks.

        Many requests must not take the processor from an emergency stop.
        """
        encoded, last, messages = self._history
        if time.monotonic() - encoded > HISTORY_AGE_S:
            payloads, last = [payload for _, payload in self._ticks], self._seq
            messages = self._past.messages()
            messages += [
                encode_message("history", _RAW(_columns(payloads[first : first + PART_TICKS])))
                for first in range(0, len(payloads), PART_TICKS)
            ]
            self._history = time.monotonic(), last, messages
        later = b",".join(payload for seq, payload in self._ticks if seq > last)
        return messages, b"[%s]" % later

    # Requests

    async def request(
        self,
        op: str,
        arguments: dict[str, Any],
        holder: str,
        take: bool,
        check: Callable[[], None],
    ) -> dict[str, Any]:
        """Carry out a request, and return its result; raise `FishdError`.

        holder: name of the lease under which the fish swims
        take: whether to take the fish from an experiment
        check: raises `FishdError` if the sender no longer drives; a request may have to wait
        """
        if op == "stop":  # must not wait for a controller that loads
            return _builtins(await self._stopper.stop())
        with self._waiting_request():
            async with self._taking:
                return await self._perform(op, arguments, holder, take, check)

    async def list_policies(self) -> list[PolicyInfo]:
        """Return the named policies of fishd; raise `FishError`."""
        with self._waiting_request():
            return await self._fish.policies()

    async def read_settings(self) -> tuple[dict[str, Any], Calibrations | None]:
        """Return configuration and calibrations of fishd, None without any; raise `FishError`."""
        with self._waiting_request():
            settings = await self._fish.config()
            try:
                return settings, await self._fish.calibrations()
            except Refused:
                return settings, None

    @contextmanager
    def _waiting_request(self) -> Iterator[None]:
        """Count a request that may wait for this fish; raise `Busy` for one too many."""
        if self._waiting >= MAX_WAITING_REQUESTS:
            raise Busy(f"{self._waiting} requests wait for this fish already; try again later")
        self._waiting += 1
        try:
            yield
        finally:
            self._waiting -= 1

    async def _perform(
        self,
        op: str,
        arguments: dict[str, Any],
        holder: str,
        take: bool,
        check: Callable[[], None],
    ) -> dict[str, Any]:
        fish = self._fish
        check()
        if op == "clear-fault":
            return _builtins(await fish.clear_fault())
        if op == "restart":
            return _builtins(await fish.restart())
        if op == "mark":
            return _builtins(await fish.mark(arguments["text"]))
        for is_last in (False, True):
            check()
            await self._hold(holder, take)
            check()
            try:
                if op == "set-controller":
                    name, parameters = arguments["name"], arguments["parameters"]
                    return _builtins(await fish.set_controller(name, **parameters))
                if op == "set-parameters":
                    return _builtins(await fish.set_parameters(**arguments["parameters"]))
                return _builtins(await fish.tare(arguments["seconds"]))
            except LeaseLost:  # another client has stopped the fish since
                await self._drop_lease()
                if is_last:
                    raise
        raise AssertionError

    async def _hold(self, holder: str, take: bool) -> None:
        """Hold the lease of the fish: where this process ends, the fish comes to rest."""
        if self._lease:
            return
        stack = AsyncExitStack()
        renewal = await stack.enter_async_context(
            self._fish.lease(text.line(holder, 60), take, idle_limit=None)
        )
        self._lease = _HeldLease(renewal, stack)

    async def give_back(self, is_driven: Callable[[], bool] = lambda: False) -> None:
        """End the lease: the fish comes to rest, if it swims under it.

        It does so at once, also while a controller is loaded, which then does not start.

        is_driven: returns whether another page has begun to drive, which then keeps the lease
        """
        if self._lease and self._taking.locked():
            with suppress(FishError):
                await self._stopper.end_lease(self._lease.renewal.token)
        async with self._taking:
            if not is_driven():
                await self._drop_lease()

    async def _drop_lease(self) -> None:
        lease, self._lease = self._lease, None
        if lease:
            with suppress(FishError):
                await lease.stack.aclose()


class _HeldLease(NamedTuple):
    """Lease of the fish."""

    renewal: LeaseRenewal
    stack: AsyncExitStack
    """Ends the lease when it is closed."""


def _builtins(result: Struct) -> dict[str, Any]:
    builtins: dict[str, Any] = msgspec.to_builtins(result)
    return builtins


def _columns(payloads: Iterable[bytes]) -> dict[str, Any]:
    """Return ticks as columns by field; those of quantities and readings are in mappings."""
    ticks = [_decode_tick(payload) for payload in payloads]
    columns: dict[str, Any] = {}
    for name in Tick.__struct_fields__:
        column = [getattr(tick, name) for tick in ticks]
        if name in ("quantities", "readings"):
            columns[name] = _transpose([{} if row is UNSET else row for row in column])
        elif name not in _OPTIONAL or any(value is not UNSET for value in column):
            columns[name] = [None if value is UNSET else value for value in column]
    return columns


def _transpose(rows: Iterable[dict[str, float]]) -> dict[str, list[float | None]]:
    """Return the values of each name, None in the rows without it."""
    rows = list(rows)
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}
