"""Recorder of a running fishd: a separate process that subscribes to telemetry."""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

import msgspec
import zmq

from fishd.client import Fish
from fishd.client.zmq_sockets import TELEMETRY_TIMEOUT_S, Subscription, connect_subscriber
from fishd.core import text
from fishd.core.camera_frames import FrameHead, Pixels
from fishd.core.errors import FishError, NoDaemon, RecordingError, Refused
from fishd.core.protocol import Calibrations
from fishd.core.signals import Status
from fishd.core.tail_reading import RecordedTail
from fishd.recording.summary import TickHead
from fishd.recording.writer import CHANNELS, RunWriter

if TYPE_CHECKING:
    from fishd.core.keys import Access

DRAIN_INTERVAL_S = 0.2
"""Interval at which messages are read from their queue, to wake up rarely [s]."""
FLUSH_INTERVAL_S = 0.5
"""Interval of writes to the kernel: a kill loses at most this time and `DRAIN_INTERVAL_S` [s]."""
SYNC_INTERVAL_S = 10.0
"""Interval of writes to the disk: a power cut loses at most this time [s]."""
POLL_INTERVAL_S = 0.02
"""Interval at which messages are read at the end of a recording [s]."""
FISHD_TIMEOUT_S = 1.0
"""Time without a message after which the recorder looks for fishd again [s]."""
MIN_FREE_BYTES = 16 * 2**20
"""Free space on the disk below which recordings end [bytes]."""
STATUS_FIELDS = (
    "version",
    "pid",
    "name",
    "robot",
    "tick",
    "amplitude_limit",
    "lowest_angle",
    "highest_angle",
    "force_unit",
    "realtime",
)
"""Fields of the status of each fishd that are recorded."""
MAX_WAITING_MESSAGES = 20000
"""Maximum number of messages that wait for a delayed recorder: a quarter of an hour."""
MAX_STALL_S = 1.0
"""Time of a write to the disk above which the recorder reports it [s]."""
TAKEOVER_MESSAGE = (
    "another fishd has taken over: the recording continues with it; whether ticks of the former "
    "one were lost is not known"
)


class FrameSource(Protocol):
    """A camera whose frames are recorded, such as `fishd.camera.tap.CameraTap`."""

    def set_time(self, t: float, monotonic: float) -> None:
        """Set the clock offset from the times of a tick: unix, and on fishd's clock [s]."""

    def take(self) -> tuple[list[str], list[tuple[FrameHead, Pixels]]]:
        """Return a line for the user per change of the camera's state, and the new frames."""

    def take_tails(self) -> list[RecordedTail]:
        """Return the fin angles since the previous call."""

    def count_missing(self) -> int | None:
        """Return how many published frames have not arrived; None if the camera does not say."""

    def close(self) -> None:
        """Disconnect; may be called twice."""


class Position(NamedTuple):
    """Position of a recorder in the ticks of a fishd."""

    pid: int
    """Process of the fishd."""
    seq: int
    """Number of its latest stored tick."""


class Recorder:
    """Recorder of all telemetry of a fishd until it is stopped, across restarts of fishd."""

    def __init__(
        self,
        endpoint: str | None,
        open_writer: Callable[[], RunWriter],
        *,
        tell: Callable[[str], None],
        after: Position | None = None,
        progress: Callable[[RunWriter], None] = lambda writer: None,
        due: Callable[[RunWriter], bool] = lambda writer: False,
        camera: FrameSource | None = None,
    ) -> None:
        """
        endpoint: control socket of fishd; None for that of this machine
        open_writer: begins a recording
        tell: called with a line for the user about an incident
        after: position of a recording that this one continues
        progress: called once a second
        due: returns whether to close this recording and begin the next one
        camera: source of the frames of a camera; it is closed with the recorder
        """
        self._endpoint = endpoint
        self._open_writer = open_writer
        self._tell, self._progress, self._due = tell, progress, due
        self._telemetry: Telemetry | None = None
        self._camera = camera
        self._writer: RunWriter | None = None
        self._described: Description | None = None
        self._after = after
        self._seq = 0
        self._gone = False
        self._refused = 0
        """Number of messages that are not fishd's."""
        self._has_losses = False
        self.has_unknown_losses = False
        """Whether ticks or frames may be lost that are not counted, as after every error."""
        self.reason = "stopped"
        """Reason of the end, for the file."""

    def __enter__(self) -> Self:
        """Begin the recording; raise `NoDaemon`, `Refused`, `RecordingError`."""
        try:
            with Fish(self._endpoint) as fish:
                self._described = describe_daemon(fish)
                self._telemetry = Telemetry(fish, self.status.telemetry, self._tell)
            self._open()
            self._begin(self._telemetry)
        except BaseException:
            self.has_unknown_losses = True
            self._close()
            raise
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """Finish the file, also after an error; raise `RecordingError`."""
        self._close()
        if self._refused > 1:
            self._tell(f"messages that are not fishd's, ignored: {self._refused}")
        was_in_doubt = self.has_unknown_losses or error is not None
        self.has_unknown_losses = True  # until the file is finished
        self.writer.close(self.reason if error is None else text.describe_error(error))
        self.has_unknown_losses = was_in_doubt

    def _begin(self, telemetry: "Telemetry") -> None:
        """Wait until telemetry arrives; if it does not, ticks count as lost from now on."""
        if self._after and self._after.pid == self.status.pid:
            self.writer.tally.expect(self._after.seq)
        elif self._after:
            self._doubt("fishd was restarted meanwhile: how many ticks were lost is not known")
        elif not telemetry.wait(TELEMETRY_TIMEOUT_S):
            self.writer.status(self.status)

    @property
    def position(self) -> Position | None:
        """Position of the latest tick that is stored, by this recorder or the one before it."""
        if not self.began or not self.writer.stored_seq:
            return self._after
        return Position(self.status.pid, self.writer.stored_seq)

    @property
    def is_complete(self) -> bool:
        """Whether the files hold every tick and frame since the beginning, as far as is known."""
        return not (self._has_losses or self.has_unknown_losses)

    @property
    def began(self) -> bool:
        """Whether a file was opened."""
        return self._writer is not None

    @property
    def status(self) -> Status:
        """Latest status that the recorder has requested from fishd."""
        assert self._described
        return self._described.status

    @property
    def writer(self) -> RunWriter:
        """Writer of the current recording."""
        assert self._writer is not None
        return self._writer

    def run(self, stopping: Callable[[], bool], seconds: float | None = None) -> None:
        """Record until `stopping`, or for this time [s]; raise `RecordingError`."""
        telemetry = self._telemetry
        assert telemetry
        looked = flushed = synced = progressed = start = time.monotonic()
        while not stopping():
            now = time.monotonic()
            if seconds is not None and now - start >= seconds:
                self.reason = f"after {seconds:g} s, as requested"
                break
            time.sleep(DRAIN_INTERVAL_S)
            self._take_all(telemetry)
            if self._camera:
                self._take_frames(self._camera)
            if now - flushed >= FLUSH_INTERVAL_S - DRAIN_INTERVAL_S / 2:
                flushed = now
                sync = now - synced >= SYNC_INTERVAL_S
                synced = now if sync else synced
                self.writer.flush(sync=sync)
                if (stall := time.monotonic() - now) > MAX_STALL_S:
                    self._tell(f"a write to the disk took {stall:.1f} s; ticks wait meanwhile")
                self._check_room()
            if now - progressed >= 1.0:
                progressed = now
                self._progress(self.writer)
                if self._due(self.writer):
                    self._continue_in_next_file()
            if now - max(looked, telemetry.heard) >= FISHD_TIMEOUT_S:
                looked = now
                self._look_for_fishd(telemetry)
        self._count_last_ticks(telemetry)
        self._count_last_frames()

    def _continue_in_next_file(self) -> None:
        self.writer.close("continued in the next file")
        self._open()
        self.writer.tally.expect(self._seq)

    def _take_all(self, telemetry: "Telemetry") -> None:
        for topic, payload in telemetry.messages():
            self._take(topic, payload)

    def _count_last_ticks(self, telemetry: "Telemetry") -> None:
        """Take the ticks that fishd has published until now; count those that do not arrive."""
        try:
            with Fish(self._endpoint) as fish:
                status = fish.status()
        except FishError:
            self._doubt_end(
                f"fishd does not answer: whether ticks after tick {self._seq} were lost is not "
                "known"
            )
            return
        deadline = time.monotonic() + TELEMETRY_TIMEOUT_S
        while self._seq < status.seq and time.monotonic() < deadline:
            self._take_all(telemetry)
            time.sleep(POLL_INTERVAL_S)
        restarts = self.writer.tally.restarts
        known = len(self.writer.gaps)
        self.writer.status(status)
        self._report_gaps(known, f"up to tick {status.seq}, at the end")
        # Later ticks than that of the status may have arrived by now.
        if status.pid != self.status.pid or self.writer.tally.restarts > restarts:
            self._doubt_end("at the end another fishd runs, whose ticks are not recorded")

    def _count_last_frames(self) -> None:
        """Count the frames that the camera has published and that have not arrived."""
        if not self._camera:
            return
        missing = self._camera.count_missing()
        self._take_frames(self._camera)
        if missing is None:
            self._doubt_end(
                "the camera does not answer: whether its last frames were lost is not known"
            )
        elif missing:
            self.writer.tally.lose_frames(missing)
            self._lose(f"at the end, frames were lost: {missing}")

    def _report_gaps(self, known: int, where: str) -> None:
        """Report the gaps of the recording after the first `known` ones."""
        for gap in self.writer.gaps[known:]:
            self._lose(f"{where}, ticks were lost: {gap.lost}")

    def _lose(self, line: str) -> None:
        """Report a counted loss."""
        self._has_losses = True
        self._tell(line)

    def _doubt(self, line: str) -> None:
        """Report that it is not known what was lost."""
        self.has_unknown_losses = True
        self._tell(line)

    def _doubt_end(self, line: str) -> None:
        """Report that it is not known what was lost at the end; the file says so, too."""
        self._doubt(line)
        self.reason = f"{self.reason}; {line}"

    def _take_frames(self, camera: FrameSource) -> None:
        news, frames = camera.take()
        for line in news:
            self._tell(line)
            with suppress(FishError), Fish(self._endpoint, timeout=0.5) as fish:
                fish.mark(text.line(line))
        for head, pixels in frames:
            if lost := self.writer.frame(head, pixels):
                self._lose(f"just before frame {head.seq}, frames were lost: {lost}")
        for tail in camera.take_tails():
            self.writer.tail(tail)

    def _close(self) -> None:
        if self._telemetry:
            self._telemetry.close()
        if self._camera:
            self._camera.close()

    def _open(self) -> None:
        assert self._described
        self._writer = self._open_writer()
        self._described.write(self._writer)

    def _take(self, topic: str, payload: bytes) -> None:
        known, restarts = len(self.writer.gaps), self.writer.tally.restarts
        known_steps = len(self.writer.tally.clock_steps)
        try:
            message = self.writer.message(topic, payload)
        except msgspec.DecodeError:
            self._refused += 1
            if self._refused == 1:  # the total is reported at the end
                self._tell(f"a message of topic {topic} is not fishd's: ignored")
            return
        if isinstance(message, TickHead):
            if message.seq <= self._seq:
                self._doubt(TAKEOVER_MESSAGE)
            elif self._gone:
                self._tell("fishd sends again: the recording continues")
            self._gone = False
            self._seq = message.seq
            if self._camera:
                self._camera.set_time(message.t, message.time)
            self._report_gaps(known, f"just before tick {message.seq}")
            for step in self.writer.tally.clock_steps[known_steps:]:
                self._tell(str(step))
        elif isinstance(message, Status):
            self._report_gaps(known, f"up to tick {message.seq}")
            if self.writer.tally.restarts > restarts:  # its ticks had higher numbers
                self._doubt(TAKEOVER_MESSAGE)
            # After its first ticks, so that the file assigns the ticks to the right fishd.
            if message.pid != self.status.pid and self._seq <= message.seq:
                self._ask_again()
        elif message.kind == "calibration":
            self._ask_again()

    def _ask(self) -> "Description":
        """Return the description of fishd; raise `FishError`."""
        with Fish(self._endpoint) as fish:
            return describe_daemon(fish)

    def _ask_again(self) -> None:
        """Update the description of fishd; without an answer, retry at its next status."""
        with suppress(FishError):
            self._described = self._ask()
            self._described.write(self.writer)

    def _look_for_fishd(self, telemetry: "Telemetry") -> None:
        """Connect telemetry again if fishd has another address now, or if the connection is dead.

        Otherwise it connects again itself.
        """
        try:
            with Fish(self._endpoint, timeout=0.5) as fish:
                telemetry.renew(fish.status().telemetry, fish.access)
        except FishError as error:
            if not self._gone:
                is_silent = isinstance(error, NoDaemon)
                why = "fishd does not answer" if is_silent else text.line(str(error))
                self._tell(f"{why}: the recording waits for it")
            self._gone = True

    def _check_room(self) -> None:
        free = self.writer.free()
        if free < MIN_FREE_BYTES:
            raise OutOfRoom(
                f"{self.writer.path}: the recording ends after {self.writer.tally.seconds:.0f} s: "
                f"only {free / 2**20:.0f} MB are free on this disk"
            )


class Description(NamedTuple):
    """Description of a fishd: status, configuration and calibrations."""

    status: Status
    config: dict[str, Any]
    calibrations: Calibrations | None

    def write(self, writer: RunWriter) -> None:
        """Write the description to a recording; raise `RecordingError`."""
        about = {name: str(getattr(self.status, name)) for name in STATUS_FIELDS}
        writer.describe(self.config, about, self.status.readings)
        if self.calibrations is not None:
            writer.calibrated(self.calibrations)


def describe_daemon(fish: Fish) -> Description:
    """Return the description of the fishd of a connection; raise `FishError`."""
    status, config = fish.status(), fish.config()
    try:
        return Description(status, config, fish.calibrations())
    except Refused:  # a simulated fish may have none
        return Description(status, config, None)


class OutOfRoom(RecordingError):
    """The disk is almost full, and the recording has ended; the file is finished."""


class Telemetry:
    """Subscription to all topics of telemetry, with a long queue."""

    def __init__(self, fish: Fish, address: str, tell: Callable[[str], None]) -> None:
        """Raises `NoDaemon` if the address is invalid."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        topics = [topic.encode() for topic in CHANNELS]
        options = {zmq.RCVHWM: MAX_WAITING_MESSAGES, zmq.RECONNECT_IVL: 10}

        self._access = fish.access

        def connect(address: str) -> "zmq.Socket[bytes]":
            return connect_subscriber(
                self._context, address, *topics, access=self._access, options=options
            )

        source = f"the fishd at {fish.endpoint}"
        self._subscription = Subscription(connect, address, source, tell)

    @property
    def heard(self) -> float:
        """Time of the latest message [s, monotonic]."""
        return self._subscription.heard

    def wait(self, seconds: float) -> bool:
        """Wait for the next message, and return whether there is one."""
        return bool(self._subscription.socket.poll(int(seconds * 1e3)))

    def renew(self, address: str, access: "Access | None") -> None:
        """Connect again if the address is another one, or if the connection is dead."""
        subscription, self._access = self._subscription, access
        is_useless = address != subscription.address or subscription.is_dead()
        if is_useless and not self.wait(0.0):
            subscription.replace(address)

    def messages(self) -> Iterator[tuple[str, bytes]]:
        """Yield topic and payload of each waiting message."""
        for _ in range(MAX_WAITING_MESSAGES):
            try:
                frames = self._subscription.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._subscription.hear()
            topic = frames[0].decode("ascii", "replace")
            if len(frames) == 2 and topic in CHANNELS:
                yield topic, frames[1]

    def close(self) -> None:
        """Disconnect."""
        self._context.destroy(linger=0)
