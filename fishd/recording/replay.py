"""Publishes a recording as fishd would, so that viewers work on it as if it were live.

Telemetry is the recorded bytes, on a PUB socket. Beside it a ROUTER socket answers what a viewer
asks, such as `status`, and refuses to steer.
"""

import os
import time
from contextlib import ExitStack
from functools import cached_property
from typing import Any, Self

import zmq
from msgspec import UNSET
from msgspec.structs import replace

from fishd import __version__
from fishd.core import addresses, protocol
from fishd.core.errors import RecordingError, Refused, StartupError
from fishd.core.signals import Event, Percentiles, Status, Tick, Timing
from fishd.recording.reader import Run

LONGEST_PAUSE = 5.0
"""A longer silence in the recording is cut short to this [s]."""
JOINING = 0.3
"""Subscribers that try again all the time are given so long to connect [s]."""
RIVAL = "a fishd or another replay"
ADVICE = "end it, or give this replay addresses of its own with --control and --address"
NOT_LIVE = "this is a replay of {}: it can be watched, not steered"


class Replay:
    """A recording on sockets of its own; a context manager."""

    def __init__(self, run: Run, telemetry: str, control: str) -> None:
        """
        telemetry, control: addresses, as in the configuration of fishd

        Raises `RecordingError` without a tick, and `StartupError` where an address cannot be had.
        """
        self._run = run
        self._messages = list(run.messages())
        first = next((each for each in self._messages if isinstance(each, Tick)), None)
        if first is None:
            raise RecordingError(f"{run.path}: there is no tick to replay")
        self._tick = first
        self._recorded: Status | None = next(iter(run.statuses), None)
        self._parameters: dict[str, Any] = self._recorded.parameters if self._recorded else {}
        with ExitStack() as stack:
            context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
            stack.callback(context.destroy, linger=200)
            for address, option in ((control, "--control"), (telemetry, "--address")):
                if why := addresses.find_listen_problem(address):
                    raise StartupError(f"{option}: '{address}' is no address to serve: {why}")
                stack.enter_context(addresses.claim_address(address, RIVAL, ADVICE))
            self._publisher = context.socket(zmq.PUB)
            self.telemetry = _bound(self._publisher, telemetry, "--address")
            self._router = context.socket(zmq.ROUTER)
            self._router.set(zmq.MAXMSGSIZE, protocol.MAX_MESSAGE)
            self.control = _bound(self._router, control, "--control")
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def play(self, speed: float) -> None:
        """Publish all of it.

        speed: seconds of the recording in a second
        """
        self._answer_until(time.monotonic() + JOINING)
        due, before = time.monotonic(), self._tick.t
        for entry, message in zip(self._run.entries, self._messages, strict=True):
            due += min(LONGEST_PAUSE, max(0.0, message.t - before)) / speed
            before = message.t
            self._answer_until(due)
            self._keep(message)
            self._publisher.send_multipart([entry.topic.encode(), entry.payload])
            if isinstance(message, Tick) and self._recorded is None and self._whole_second():
                status = protocol.encode(self.status())
                self._publisher.send_multipart([b"status", status])

    def status(self) -> Status:
        """What fishd said last, or would say, as of the tick that was published last."""
        tick = self._tick
        status = self._recorded or self._made_up
        return replace(
            status,
            t=tick.t,
            uptime=status.uptime if self._recorded else tick.t - self._run.ticks[0].t,
            mode=tick.mode,
            controller=tick.controller,
            parameters=self._parameters,
            servo_on=tick.servo_on,
            thrust=tick.thrust,
            frequency=tick.frequency,
            seq=tick.seq,
            missed=tick.missed,
            phi_c=tick.phi_c,
            power=None if tick.power is UNSET else tick.power,
            pid=os.getpid(),
            telemetry=self.telemetry,
            name=f"replay of {self._run.name}",
        )

    def _keep(self, message: Tick | Event | Status) -> None:
        if isinstance(message, Tick):
            self._tick = message
        elif isinstance(message, Status):
            self._recorded, self._parameters = message, message.parameters
        elif "parameters" in message.data:
            self._parameters = message.data["parameters"]

    def _whole_second(self) -> bool:
        return self._tick.seq % max(1, round(1.0 / self._made_up.tick)) == 0

    @cached_property
    def _made_up(self) -> Status:
        """The status of a run in virtual time, in which none was recorded."""
        config, none = self._run.config, Percentiles(0.0, 0.0, 0.0, 0)
        return Status(
            t=self._tick.t,
            version=self._run.about.get("version", __version__),
            pid=os.getpid(),
            uptime=0.0,
            mode=self._tick.mode,
            reason=None,
            controller=self._tick.controller,
            parameters={},
            servo_on=True,
            thrust=0.0,
            frequency=0.0,
            tick=config.tick,
            amplitude_limit=config.amplitude_limit,
            lowest=-config.amplitude_limit,
            highest=config.amplitude_limit,
            seq=0,
            missed=0,
            overruns=0,
            timing=Timing(none, none, {}),
            robot=config.robot,
            degraded=(),
            counters={},
            realtime=False,
            telemetry=self.telemetry,
        )

    def _answer_until(self, deadline: float) -> None:
        """Answer requests until it is time for the next message."""
        while True:
            wait = deadline - time.monotonic()
            if not self._router.poll(max(0, round(wait * 1e3))):
                return
            *route, payload = self._router.recv_multipart()
            self._router.send_multipart([*route, self._reply(payload)])

    def _reply(self, payload: bytes) -> bytes:
        identity = protocol.request_id(payload)
        try:
            request = protocol.decode_request(payload)
            return protocol.success(identity, self._result(request.op))
        except Refused as error:
            return protocol.failure(identity, error)

    def _result(self, op: str) -> Any:
        if op == "status":
            return self.status()
        if op == "config" and self._run.has_settings(0):
            try:
                return self._run.settings_of(0)
            except RecordingError as error:
                raise Refused("replay", str(error)) from None
        if op == "calibrations" and self._run.calibrations:
            return self._run.calibrations[-1]
        raise Refused("replay", NOT_LIVE.format(self._run.name))


def _bound(socket: "zmq.Socket[bytes]", address: str, option: str) -> str:
    """Bind what is `claimed`; the address that clients connect to. Raises `StartupError`."""
    path = addresses.socket_path(address)
    before = os.umask(0o117) if path else None
    try:
        if path:
            path.unlink(missing_ok=True)
        socket.set(zmq.IPV6, addresses.is_ipv6(address))
        socket.bind(address)
    except (zmq.ZMQError, OSError) as error:
        why = zmq.strerror(error.errno or 0)
        raise StartupError(
            f"cannot publish at {address}: {why}, by a fishd perhaps; end that, or name another "
            f"with {option}"
        ) from None
    finally:
        if before is not None:
            os.umask(before)
    return socket.get_string(zmq.LAST_ENDPOINT)
