"""Replay of a recording on the sockets of a fishd, so that viewers show it as if it were live.

Telemetry is the recorded bytes, on a PUB socket. A ROUTER socket answers the requests of viewers,
such as `status`, and refuses commands.
"""

import os
import time
from contextlib import ExitStack
from functools import cached_property
from typing import Any, Self

import zmq
from msgspec.structs import replace

from fishd import __version__
from fishd.core import addresses, protocol
from fishd.core.errors import RecordingError, Refused, StartupError
from fishd.core.signals import Event, Percentiles, ReadingState, Status, Tick, Timing
from fishd.recording.reader import Run

MAX_PAUSE_S = 5.0
"""Maximum length of a pause; longer ones in the recording are shortened [s]."""
SUBSCRIBER_WAIT_S = 0.3
"""Time for waiting subscribers to connect before the first message [s]."""
RIVAL = "a fishd or another replay"
ADVICE = "end it, or choose other addresses for this replay with --control and --address"
REPLAY_REFUSAL = "this is a replay of {}: it can be watched, but not controlled"


class Replay:
    """Replay of a recording on separate sockets; a context manager."""

    def __init__(self, run: Run, telemetry: str, control: str) -> None:
        """
        telemetry, control: addresses, as in the configuration of fishd

        Raises `RecordingError` without a tick, and `StartupError` if an address cannot be bound.
        """
        self._run = run
        self._messages = list(run.messages())
        first = next((message for message in self._messages if isinstance(message, Tick)), None)
        if first is None:
            raise RecordingError(f"{run.path} contains no tick to replay")
        self._tick = first
        self._seconds = 0.0
        """Time of that tick since the first one [s]."""
        self._recorded: Status | None = next(iter(run.statuses), None)
        self._parameters: dict[str, Any] = self._recorded.parameters if self._recorded else {}
        with ExitStack() as stack:
            context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
            stack.callback(context.destroy, linger=200)
            for address, option in ((control, "--control"), (telemetry, "--address")):
                if why := addresses.find_listen_problem(address):
                    raise StartupError(
                        f"{option}: '{address}' is not an address to listen on: {why}"
                    )
                stack.enter_context(addresses.claim_address(address, RIVAL, ADVICE))
            self._publisher = context.socket(zmq.PUB)
            self.telemetry = _bind_socket(self._publisher, telemetry, "--address")
            self._router = context.socket(zmq.ROUTER)
            self._router.set(zmq.MAXMSGSIZE, protocol.MAX_MESSAGE)
            self.control = _bind_socket(self._router, control, "--control")
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def play(self, speed: float) -> None:
        """Publish all messages.

        speed: seconds of the recording per second
        """
        self._answer_until(time.monotonic() + SUBSCRIBER_WAIT_S)
        due, before = time.monotonic(), self._run.times[0]
        messages = zip(self._run.entries, self._messages, self._run.times, strict=True)
        for entry, message, at in messages:
            due += min(MAX_PAUSE_S, max(0.0, at - before)) / speed
            before = at
            self._answer_until(due)
            self._update_state(message)
            self._publisher.send_multipart([entry.topic.encode(), entry.payload])
            if isinstance(message, Tick):
                self._seconds = at
            if isinstance(message, Tick) and self._recorded is None and self._whole_second():
                status = protocol.encode(self.status())
                self._publisher.send_multipart([b"status", status])

    def status(self) -> Status:
        """Return the recorded or a synthetic status, updated to the latest published tick."""
        tick = self._tick
        status = self._recorded or self._synthetic_status
        values = tick.readings or {}
        return replace(
            status,
            t=tick.t,
            clock=tick.time,
            uptime=status.uptime if self._recorded else self._seconds,
            mode=tick.mode,
            controller=tick.controller,
            parameters=self._parameters,
            servo_on=tick.servo_on,
            thrust=tick.thrust,
            frequency=tick.frequency,
            seq=tick.seq,
            missed_slots=tick.missed_slots,
            phi_c=tick.phi_c,
            readings={
                name: replace(reading, value=values.get(name))
                for name, reading in status.readings.items()
            },
            pid=os.getpid(),
            telemetry=self.telemetry,
            name=f"replay of {self._run.name}",
        )

    def _update_state(self, message: Tick | Event | Status) -> None:
        if isinstance(message, Tick):
            self._tick = message
        elif isinstance(message, Status):
            self._recorded, self._parameters = message, message.parameters
        elif "parameters" in message.data:
            self._parameters = message.data["parameters"]

    def _whole_second(self) -> bool:
        return self._tick.seq % max(1, round(1.0 / self._synthetic_status.tick)) == 0

    @cached_property
    def _synthetic_status(self) -> Status:
        """Status for a run in virtual time, whose recording contains none."""
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
            lowest_angle=-config.amplitude_limit,
            highest_angle=config.amplitude_limit,
            seq=0,
            missed_slots=0,
            overruns=0,
            timing=Timing(none, none, {}),
            robot=config.robot,
            limitations=(),
            recovered_errors={},
            realtime=False,
            telemetry=self.telemetry,
            readings={
                name: ReadingState(
                    unit=reading.unit,
                    description=reading.description,
                    sensor=name,
                    value=None,
                    age=None,
                    problem=None,
                )
                for name, reading in config.readings.items()
            },
        )

    def _answer_until(self, deadline: float) -> None:
        """Answer requests until the deadline of the next message."""
        while True:
            remaining = deadline - time.monotonic()
            if not self._router.poll(max(0, round(remaining * 1e3))):
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
        raise Refused("replay", REPLAY_REFUSAL.format(self._run.name))


def _bind_socket(socket: "zmq.Socket[bytes]", address: str, option: str) -> str:
    """Bind a claimed address, and return the one for clients; raise `StartupError`."""
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
            f"cannot publish at {address}: {why}; end the program that uses it, or choose another "
            f"address with {option}"
        ) from None
    finally:
        if before is not None:
            os.umask(before)
    return socket.get_string(zmq.LAST_ENDPOINT)
