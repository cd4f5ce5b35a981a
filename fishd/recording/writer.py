"""Writer of a recording: an MCAP file that Foxglove, Lichtblick and PlotJuggler open.

docs/how-to/recording.md describes its layout.
"""

import errno
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic, time_ns
from typing import Any, Self

import msgspec
from mcap.writer import CompressionType, Writer
from msgspec import Struct
from msgspec.structs import replace

from fishd.config import Config, to_yaml
from fishd.core.camera_frames import FrameHead, Pixels
from fishd.core.decoding import decoder
from fishd.core.errors import RecordingError
from fishd.core.protocol import Calibrations
from fishd.core.schema import Reading, json_schema, schema_name
from fishd.core.signals import Event, Status, Tick
from fishd.core.tail_reading import RecordedTail
from fishd.recording.axis import Axis
from fishd.recording.images import (
    IMAGE_SCHEMA,
    IMAGE_TOPIC,
    TAIL_TOPIC,
    encode_frame,
    image_json_schema,
)
from fishd.recording.numbering import next_recording_number
from fishd.recording.part_file import SUFFIX, PartFile
from fishd.recording.provenance import Source, provenance
from fishd.recording.summary import (
    Gap,
    Message,
    Summary,
    Tally,
    TickHead,
    place,
    times_of,
    to_metadata,
)

CHANNELS: dict[str, type[Struct]] = {"tick": Tick, "event": Event, "status": Status}
"""Recorded topics of telemetry, and the types of their messages."""

CHUNK_BYTES = 32 * 2**10
"""Size at which a chunk is closed, which blocks the writer for 0.5 ms [bytes]."""
MAX_TIME_S = 1e10
"""Largest time of a message, before or after 1970: MCAP counts nanoseconds in 64 bits [s]."""
UNITS = "reading_units"
"""Key of the metadata of a fishd with the units of its readings, as JSON."""
CONFIG_ATTACHMENT, CALIBRATIONS_ATTACHMENT = "config.yaml", "calibrations.json"
"""Names of attachments."""


class RunWriter:
    """A recording in progress: a publisher of ticks and events, and a context manager.

    Until it is closed, the file is named `<run>.mcap.part`. All flushed data stay readable, however
    the process ends. A file is never overwritten.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        source: Source = "fishd",
        operator: str = "",
        subject: str = "",
        note: str = "",
        extra: Mapping[str, str] | None = None,
        is_temporary: bool = False,
    ) -> None:
        """
        path: path of the finished file; `.mcap` is added if it is missing
        source: origin of the ticks: `fishd`, `simulation` for virtual time, `import` for a table
        operator: name of the operator; by default this user
        subject: name of the fish; note: purpose
        extra: further metadata, such as the point of a sweep
        is_temporary: whether the file is removed after an error, so that none can be recovered

        Raises `RecordingError` if the file exists or cannot be created.
        """
        path = Path(path)
        self.path = path if path.name.endswith(SUFFIX) else path.with_name(path.name + SUFFIX)
        self.tally = Tally()
        self._stored = self.tally.summary
        """Summary of what was written to the kernel."""
        self.stored_seq = 0
        """Number of the latest tick that was written to the kernel; 0 before the first."""
        self._has_failed = False
        self._is_temporary = is_temporary
        self._axis = Axis()
        self._origin_ns: int | None = None
        """Log time of the first message [ns, unix]."""
        self._file = PartFile(self.path)
        run = self.path.name.removesuffix(SUFFIX)
        about = provenance(run, source, operator, subject, note, extra or {})
        about["number"] = str(next_recording_number(self.path.parent))
        self._closed = False
        self._encode = msgspec.json.Encoder().encode
        self._writer = Writer(self._file, CHUNK_BYTES, CompressionType.ZSTD)  # type: ignore[arg-type]
        self._writer.start(profile="", library="fishd")
        self._writer.add_metadata("fishd.run", about)
        self._channels: dict[str, int] = {}
        self.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """Finish the file; remove it after an error before the first tick."""
        if error is not None and not self.tally.summary.ticks:
            self._file.remove()
            self._give_up()
        self.close("ended" if error is None else f"ended by {type(error).__name__}")

    @property
    def part(self) -> Path:
        """Path of the recording until it is closed."""
        return self._file.path

    @property
    def size(self) -> int:
        """Current size of the file [bytes]."""
        return self._file.tell()

    @property
    def gaps(self) -> list[Gap]:
        """Gaps until now."""
        return self.tally.gaps

    @property
    def summary(self) -> Summary:
        """Summary of the recording until now; after a failed write, of what is in the file."""
        return self._stored if self._has_failed else self.tally.summary

    def free(self) -> int:
        """Return the free space on its disk [bytes]."""
        return self._file.free()

    def describe(
        self,
        config: Config | Mapping[str, Any],
        daemon: Mapping[str, str] | None = None,
        readings: Mapping[str, Reading] | None = None,
    ) -> None:
        """Record the configuration of the following ticks.

        Call it at the start, and again when another fishd takes over.

        daemon: metadata of that fishd, such as its process
        readings: readings of its sensors; those of the first fishd are in the schema of the ticks
        Raise `RecordingError` if it cannot be written.
        """
        self._register_channels(readings or {})
        units = {name: reading.unit for name, reading in (readings or {}).items()}
        about = {"number": str(self.tally.restarts), **(daemon or {}), UNITS: _to_json(units)}
        self._writer.add_metadata("fishd.daemon", about)
        self.tally.set_daemon(daemon or {})
        yaml = to_yaml(config if isinstance(config, Config) else dict(config))
        self._attach(CONFIG_ATTACHMENT, "application/yaml", yaml.encode())

    def calibrated(self, calibrations: Calibrations) -> None:
        """Record the calibrations of the following ticks; raise `RecordingError`."""
        self._attach(CALIBRATIONS_ATTACHMENT, "application/json", self._encode(calibrations))

    def tick(self, tick: Tick) -> None:
        """Record a tick."""
        self.tally.tick(tick, self._add("tick", tick, self._encode(tick)))

    def event(self, event: Event) -> None:
        """Record an event."""
        self._add("event", event, self._encode(event))
        self.tally.event(event)

    def status(self, status: Status) -> None:
        """Record a status."""
        self._add("status", status, self._encode(status))
        self.tally.status(status)

    def frame(self, head: FrameHead, pixels: Pixels) -> int:
        """Record a frame of a camera; return the number of frames that are missing before it.

        pixels: shape (height, width)
        Raise `MissingPackage` without OpenCV (extra: camera).
        """
        payload = encode_frame(head, pixels)
        self._register_camera()
        self._add(IMAGE_TOPIC, head, payload)
        return self.tally.frame(head)

    def tail(self, tail: RecordedTail) -> None:
        """Record a fin angle that a camera has measured."""
        self._register_camera()
        self._add(TAIL_TOPIC, tail, self._encode(tail))
        self.tally.tail()

    def message(self, topic: str, payload: bytes) -> TickHead | Event | Status:
        """Record the bytes of a message of telemetry, and return its content.

        Raise `msgspec.DecodeError` if it is invalid, for example if a time of it is not possible.
        """
        head = _DECODERS[topic](payload)
        for time in times_of(head):
            if not abs(time) <= MAX_TIME_S:
                raise msgspec.ValidationError(f"{time:g} s is not a valid time")
        self.tally.add(head, self._add(topic, head, payload, monotonic()))
        return head

    def flush(self, *, sync: bool = False) -> None:
        """Write all data to the kernel, so that the end of this process loses none.

        sync: wait until they are on the disk, so that a power cut loses none either
        Raise `RecordingError`.
        """
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._note_stored()
            if sync:
                self._file.sync()
        except OSError as error:
            raise self._failed(error) from None

    def close(self, reason: str = "ended") -> None:
        """Finish the file and give it its final name; may be called twice.

        reason: reason of the end, stored in the file
        Raise `RecordingError`; the `.part` then stays readable.
        """
        if self._closed:
            return
        try:
            self._register_channels({})
            self._writer.add_metadata(
                "fishd.end", to_metadata(self.tally.summary) | {"reason": reason}
            )
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._note_stored()
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            self._file.finish()
        except OSError as error:
            raise self._failed(error) from None
        self._give_up()

    def _register_channels(self, readings: Mapping[str, Reading]) -> None:
        """Register the topics of telemetry, unless they are: with the numbers that readers know."""
        if self._channels:
            return
        for topic, message in CHANNELS.items():
            schema = self._writer.register_schema(
                schema_name(message),
                "jsonschema",
                json_schema(message, readings if message is Tick else None),
            )
            self._channels[topic] = self._writer.register_channel(topic, "json", schema)

    def _register_camera(self) -> None:
        """Register the topics of a camera, unless they are: with the numbers that readers know."""
        self._register_channels({})
        if IMAGE_TOPIC in self._channels:
            return
        for topic, name, schema in (
            (IMAGE_TOPIC, IMAGE_SCHEMA, image_json_schema()),
            (TAIL_TOPIC, schema_name(RecordedTail), json_schema(RecordedTail)),
        ):
            number = self._writer.register_schema(name, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, "json", number)

    def _note_stored(self) -> None:
        self._stored, self.stored_seq = self.tally.summary, self.tally.seq

    def _give_up(self) -> None:
        """Close the file, and write nothing more."""
        self._closed = True
        self._file.close()

    def _attach(self, name: str, media_type: str, content: bytes) -> None:
        now = max(0, time_ns())
        try:
            self._writer.add_attachment(now, now, name, media_type, content)
        except OSError as error:
            raise self._failed(error) from None
        self.flush()

    def _add(
        self,
        topic: str,
        message: Message,
        payload: bytes,
        arrival: float | None = None,
    ) -> float:
        """Write a message; return its time since the first message, as `Axis.place` does [s].

        Its log time grows with the monotonic clock; its publish time is the unix time.
        """
        if self._closed:
            raise RecordingError(f"{self.path}: the recording has ended")
        for time in times_of(message):
            if not abs(time) <= MAX_TIME_S:
                raise RecordingError(f"{self.path}: {time:g} s is not a valid time")
        self._register_channels({})
        position = place(self._axis, message, arrival)
        published = max(0, round(message.t * 1e9))
        if self._origin_ns is None:
            self._origin_ns = published
        logged = max(0, self._origin_ns + round(position * 1e9))
        seq = 0 if isinstance(message, Event) else message.seq
        try:
            self._writer.add_message(
                self._channels[topic], logged, payload, published, seq & 0xFFFFFFFF
            )
        except OSError as error:
            raise self._failed(error) from None
        return position

    def _failed(self, error: OSError) -> RecordingError:
        """Close the file after a failed write, and return the error, with what was lost."""
        self._give_up()
        self._has_failed = True
        stored, seen = self._stored, self.tally.summary
        unwritten = seen.ticks - stored.ticks
        self._stored = replace(stored, lost_ticks=seen.lost_ticks + unwritten)
        lost = f", and its last {unwritten} ticks are lost" if unwritten else ""
        remedy = (
            "free some space"
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            else "make the disk writable"
        )
        if self._is_temporary or not seen.ticks:
            return RecordingError(
                f"{self.part}: cannot be written: {error.strerror or error}; {remedy}"
            )
        return RecordingError(
            f"{self.part}: the recording ends after {stored.duration:.0f} s{lost}: "
            f"{error.strerror or error}; the written part is readable; {remedy}, then run fishctl "
            f"recover {self.part}"
        )


def _to_json(value: Any) -> str:
    return msgspec.json.encode(value).decode()


_DECODERS: dict[str, Callable[[bytes], TickHead | Event | Status]] = {
    "tick": decoder(TickHead),
    "event": decoder(Event),
    "status": decoder(Status),
}
