"""Records a running fishd: a process of its own that subscribes to telemetry."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import msgspec
import zmq

from fishd.client import Fish
from fishd.core import addresses, text
from fishd.core.errors import FishError, RecordingError, Refused
from fishd.core.protocol import Calibrations
from fishd.core.signals import Status
from fishd.recording.schemas import CHANNELS
from fishd.recording.summary import TickHead
from fishd.recording.writer import RunWriter

if TYPE_CHECKING:
    from fishd.recording.camera_tap import CameraTap

DRAIN = 0.2
"""Messages are taken from their queue this often, so as to wake up seldom [s]."""
FLUSH = 0.5
"""All is handed to the kernel this often: a kill loses at most so much, and `DRAIN` [s]."""
SYNC = 10.0
"""A power cut loses at most so much [s]."""
SILENCE = 1.0
"""Without a message for so long, fishd is looked for again [s]."""
RESERVE = 16 * 2**20
"""Recordings end before the disk has less room than this [bytes]."""
ABOUT = (
    "version",
    "pid",
    "name",
    "robot",
    "tick",
    "amplitude_limit",
    "lowest",
    "highest",
    "force_unit",
    "realtime",
)
"""What is kept of the status of each fishd."""
UNTOLD = 100
"""Lines that fishd has not been told yet: older ones are forgotten."""
WAITING = 20000
"""Messages that may wait for a recorder that is held up: a quarter of an hour."""
TAKEN_OVER = "another fishd has taken over: the recording goes on with it"


class Recorder:
    """Writes all that a fishd says until it is told to stop, through any restart of fishd."""

    def __init__(
        self,
        endpoint: str | None,
        open_writer: Callable[[], RunWriter],
        *,
        tell: Callable[[str], None],
        progress: Callable[[RunWriter], None] = lambda writer: None,
        due: Callable[[RunWriter], bool] = lambda writer: False,
        camera: "CameraTap | None" = None,
    ) -> None:
        """
        endpoint: control socket of fishd; None looks for that of this machine
        open_writer: begins a recording
        tell: gets a line where something happens that its reader should know
        progress: called once a second
        due: is it time to close this recording and begin the next one?
        camera: what brings the frames of a camera; it is closed with the recorder
        """
        self._endpoint = endpoint
        self._open_writer = open_writer
        self._tell, self._progress, self._due = tell, progress, due
        self._telemetry = Telemetry()
        self._camera = camera
        self._writer: RunWriter | None = None
        self._described: Description | None = None
        self._seq = 0
        self._untold: deque[str] = deque(maxlen=UNTOLD)
        """What fishd could not be told, as it did not answer in time."""
        self._gone = False
        self._refused = 0
        """Messages that are none of fishd's."""
        self.reason = "stopped"
        """Why the recording ended, as the file says."""

    def __enter__(self) -> Self:
        """Begin, where there is a fishd: raises `NoDaemon`, `Refused`, `RecordingError`."""
        try:
            self._described = self._ask()
            self._telemetry.connect(self._described.status.telemetry)
            self._open()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """Finish the file, also after an error; raises `RecordingError`."""
        self._close()
        if self._refused > 1:
            self._tell(f"messages that are none of fishd's, left out: {self._refused}")
        self.writer.close(self.reason if error is None else text.describe_error(error))

    @property
    def began(self) -> bool:
        """Was a file opened?"""
        return self._writer is not None

    @property
    def status(self) -> Status:
        """What fishd said of itself when it was asked last."""
        assert self._described
        return self._described.status

    @property
    def writer(self) -> RunWriter:
        """The recording that is being written."""
        assert self._writer is not None
        return self._writer

    def run(self, stopping: Callable[[], bool], seconds: float | None = None) -> None:
        """Record until `stopping`, or for so long [s]; raises `RecordingError`."""
        heard = flushed = synced = told = began = time.monotonic()
        while not stopping():
            now = time.monotonic()
            if seconds is not None and now - began >= seconds:
                self.reason = f"after {seconds:g} s, as asked"
                break
            time.sleep(DRAIN)
            for topic, payload in self._telemetry.messages():
                self._take(topic, payload)
                heard = now
            if self._camera:
                self._take_frames(self._camera)
            if now - flushed >= FLUSH - DRAIN / 2:
                flushed = now
                sync = now - synced >= SYNC
                synced = now if sync else synced
                self.writer.flush(sync=sync)
                self._check_room()
            if now - told >= 1.0:
                told = now
                self._progress(self.writer)
                if self._due(self.writer):
                    self.writer.close("continued in the next file")
                    self._open()
            if now - heard >= SILENCE:
                heard = now
                self._look_for_fishd()

    def _take_frames(self, camera: "CameraTap") -> None:
        news, frames = camera.take()
        for line in news:
            self._tell(line)
            self._untold.append(text.line(line))
        if self._untold and not self._gone:
            self._mark_untold()
        for head, pixels in frames:
            if lost := self.writer.frame(head, pixels):
                self._tell(f"just before frame {head.seq}, frames were lost: {lost}")

    def _mark_untold(self) -> None:
        """Put it into the events; what a fishd that does not answer misses is tried again."""
        with suppress(FishError), Fish(self._endpoint, timeout=0.5) as fish:
            while self._untold:
                with suppress(Refused):
                    fish.mark(self._untold[0])
                self._untold.popleft()

    def _close(self) -> None:
        self._telemetry.close()
        if self._camera:
            self._camera.close()

    def _open(self) -> None:
        assert self._described
        self._writer = self._open_writer()
        self._described.write(self._writer)

    def _take(self, topic: str, payload: bytes) -> None:
        known, restarts = len(self.writer.gaps), self.writer.tally.restarts
        try:
            message = self.writer.message(topic, payload)
        except msgspec.DecodeError:
            self._refused += 1
            if self._refused == 1:  # a flood of them is told when all is over
                self._tell(f"a message of topic {topic} is none of fishd's: left out")
            return
        if isinstance(message, TickHead):
            if message.seq <= self._seq:
                self._tell(TAKEN_OVER)
            elif self._gone:
                self._tell("fishd is heard again: the recording goes on")
            self._gone = False
            self._seq = message.seq
            if self._camera:
                self._camera.heard(message.t, message.time)
            for gap in self.writer.gaps[known:]:
                self._tell(f"just before tick {message.seq}, ticks were lost: {gap.lost}")
        elif isinstance(message, Status):
            if self.writer.tally.restarts > restarts:  # its ticks had higher numbers
                self._tell(TAKEN_OVER)
            # Once its ticks come, so that the file says whose they are.
            if message.pid != self.status.pid and self._seq <= message.seq:
                self._ask_again()
        elif message.kind == "calibration":
            self._ask_again()

    def _ask(self) -> "Description":
        """What fishd says of itself; raises `FishError`."""
        with Fish(self._endpoint) as fish:
            return description(fish)

    def _ask_again(self) -> None:
        """A fishd that does not answer is asked again at its next status."""
        with suppress(FishError):
            self._described = self._ask()
            self._described.write(self.writer)

    def _look_for_fishd(self) -> None:
        """Telemetry comes back by itself, unless fishd has another address now."""
        try:
            with Fish(self._endpoint, timeout=0.5) as fish:
                self._telemetry.connect(fish.status().telemetry)
        except FishError:
            if not self._gone:
                self._tell("fishd is gone: the recording waits for it")
            self._gone = True

    def _check_room(self) -> None:
        free = self.writer.free()
        if free < RESERVE:
            raise OutOfRoom(
                f"{self.writer.path}: the recording ends after {self.writer.tally.seconds:.0f} s: "
                f"only {free / 2**20:.0f} MB are left on this disk"
            )


class Description(NamedTuple):
    """What a fishd says of itself when it is asked."""

    status: Status
    config: dict[str, Any]
    calibrations: Calibrations | None

    def write(self, writer: RunWriter) -> None:
        """Put it into a recording; raises `RecordingError`."""
        about = {name: str(getattr(self.status, name)) for name in ABOUT}
        writer.describe(self.config, about)
        if self.calibrations is not None:
            writer.calibrated(self.calibrations)


def description(fish: Fish) -> Description:
    """What the fishd of a fish says of itself; raises `FishError`."""
    status, config = fish.status(), fish.config()
    try:
        return Description(status, config, fish.calibrations())
    except Refused:  # a simulated fish may have none
        return Description(status, config, None)


class OutOfRoom(RecordingError):
    """A recording ended since the disk is almost full; the file is finished."""


class Telemetry:
    """All topics of telemetry, with room for many messages to wait."""

    def __init__(self) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set(zmq.RCVHWM, WAITING)
        self._socket.set(zmq.RECONNECT_IVL, 10)
        for topic in CHANNELS:
            self._socket.subscribe(topic.encode())
        self._address = ""

    def connect(self, address: str) -> None:
        """Listen to this address alone."""
        if address != self._address:
            if self._address:
                self._socket.disconnect(self._address)
            self._socket.set(zmq.IPV6, addresses.is_ipv6(address))
            self._socket.connect(address)
            self._address = address

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Topics and payloads that wait."""
        for _ in range(WAITING):
            try:
                frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            topic = frames[0].decode("ascii", "replace")
            if len(frames) == 2 and topic in CHANNELS:
                yield topic, frames[1]

    def close(self) -> None:
        """Disconnect."""
        self._context.destroy(linger=0)
