"""Reader of recordings, also of unfinished ones: a kill leaves complete chunks."""

import copy
import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import msgspec
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Footer,
    McapRecord,
    Message,
    Metadata,
    Statistics,
)  # fmt: skip
from msgspec.structs import replace

from fishd.config import Config, adopt
from fishd.core import strict_yaml, text
from fishd.core.camera_frames import FrameHead
from fishd.core.dataframes import ticks_to_frame
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError, RecordingError
from fishd.core.protocol import Calibrations
from fishd.core.signals import Event, Status, Tick
from fishd.core.tail_reading import RecordedTail
from fishd.recording.images import (
    IMAGE_TOPIC,
    TAIL_TOPIC,
    RecordedFrame,
    decode_frame,
    decode_head,
)
from fishd.recording.mcap_file import Appended, Damaged, read_records
from fishd.recording.notes import read_note
from fishd.recording.part_file import PART_SUFFIX, SUFFIX
from fishd.recording.provenance import FORMAT
from fishd.recording.summary import Gap, Summary, Tally, from_metadata
from fishd.recording.writer import (
    CALIBRATIONS_ATTACHMENT,
    CHANNELS,
    CONFIG_ATTACHMENT,
    UNITS,
)

if TYPE_CHECKING:
    from pandas import DataFrame

T = TypeVar("T")

_decode_tail: Callable[[bytes], RecordedTail] = decoder(RecordedTail)
_decode_units: Callable[[bytes], dict[str, str]] = decoder(dict[str, str])

TOPICS = dict(enumerate((*CHANNELS, IMAGE_TOPIC, TAIL_TOPIC), start=1))
"""Topics by the channel numbers of `RunWriter`, for a file whose channel records are damaged."""

COUNTED_TOPICS = {"tick": "tick", "event": "event", IMAGE_TOPIC: "frame", TAIL_TOPIC: "fin angle"}
"""Topics whose messages are counted when a recording ends, and the word for a message."""

RECOVERED = "recovered: "
"""Beginning of the reason of the end in a file that `recover` has written."""
UNFINISHED_REASON = f"{RECOVERED}the recording was not finished"

MAX_DIGITS = 9
"""Maximum number of digits of the number of a fishd in a recording."""
MAX_COLUMNS = 100
"""Maximum number of quantities of controllers in one table; each takes one number per tick."""


class Entry(NamedTuple):
    """One message of a recording."""

    topic: str
    """`tick`, `event` or `status`."""
    payload: bytes
    """JSON, exactly as fishd sent it."""
    log_time: int
    """Time of the message in the file [ns]."""


class Repeated:
    """Placeholder of a message that is in the file again."""


class Run:
    """A recording, as `open_run` reads it; its messages are decoded on demand."""

    def __init__(self, path: Path, *, with_messages: bool = True) -> None:
        """
        with_messages: whether messages are read; without them, this takes a sixth of the time

        Raises `RecordingError` if the file cannot be read, or is not a recording.
        """
        self.path = path
        self._with_messages = with_messages
        self.about: dict[str, str] = {}
        """Metadata: run, version, git commit, host, Python, operator, subject, note, and more."""
        self.daemons: list[dict[str, str]] = []
        """Metadata of each recorded fishd: version, process, robot."""
        self._yaml: dict[int, bytes] = {}
        """YAML of the configuration of each fishd, by its number."""
        self._settings: dict[int, dict[str, Any]] = {}
        """Decoded configurations, by number of the fishd."""
        self.calibrations: list[Calibrations] = []
        """Calibrations that were active, one after the other."""
        self.finished = False
        """False if the recording was not finished, or is in progress."""
        self.reason = ""
        """Reason of the end; empty unless the recording is finished."""
        self._ends: list[Summary] = []
        """Summary at the end of the recording; several after a merge of recordings."""
        self._indexed: Counter[str] = Counter()
        """Number of messages by topic, as the index at the end of the file states it."""
        self.is_damaged = False
        """Whether there are parts that cannot be read."""
        self._damages: list[int] = []
        """Number of ticks before each damaged part that may contain ticks."""
        self._missing_chunks = 0
        """Number of chunks that the index has and the file has not, if read without messages."""
        self._repeated: Counter[str] = Counter()
        """Number of messages by topic that are in the file again, and are left out."""
        self._appended = ""
        """Description of bytes that follow the end of the recording; empty if none do."""
        self._topics = dict(TOPICS)
        """Topics by the numbers of their channels."""
        self.damage_reason = ""
        """Description of the first damage; empty if unknown."""
        self.entries: list[Entry] = []
        """All messages of fishd, in the order of arrival, each once."""
        self.frame_heads: list[FrameHead] = []
        """Metadata of the frames of a camera, in the order of arrival."""
        self.tails: list[RecordedTail] = []
        """Fin angles that a camera has measured, in the order of arrival."""
        self._scan()

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.path.name.removesuffix(PART_SUFFIX).removesuffix(SUFFIX)

    @property
    def config(self) -> Config:
        """Configuration of the first fishd; raises `RecordingError` if it was not recorded."""
        return self.config_of(0)

    def config_of(self, number: int) -> Config:
        """Return the configuration of the fishd of this number; raise `RecordingError`."""
        try:
            return adopt(self.settings_of(number))
        except RecordingError:
            raise
        except FishdError as error:
            version = self.about.get("version", "unknown")
            raise RecordingError(
                f"{self.path}: the configuration of fishd {version} cannot be read by this one: "
                f"{error}"
            ) from None

    @property
    def reading_units(self) -> dict[str, str]:
        """Unit of each reading of the sensors, by name, as far as they were recorded."""
        units: dict[str, str] = {}
        for daemon in self.daemons:
            with suppress(msgspec.DecodeError):
                units |= _decode_units(daemon.get(UNITS, "{}").encode())
        return units

    def has_settings(self, number: int) -> bool:
        """Return whether the recording contains the configuration of this fishd."""
        return number in self._yaml

    def settings_of(self, number: int) -> dict[str, Any]:
        """Return the configuration as plain data, which may be changed; raise `RecordingError`."""
        if not self.has_settings(number):
            raise RecordingError(f"{self.path} does not contain the configuration of its fishd")
        if number not in self._settings:
            self._settings[number] = self._parsed(number)
        return copy.deepcopy(self._settings[number])

    def _parsed(self, number: int) -> dict[str, Any]:
        name = f"{self.path}: {CONFIG_ATTACHMENT} of fishd {number}"
        try:
            data = strict_yaml.parse(self._yaml[number].decode(), typed=False).data
        except UnicodeDecodeError as error:
            raise RecordingError(f"{name}: not a text in UTF-8 ({error.reason})") from None
        except strict_yaml.YamlProblem as problem:
            raise RecordingError(f"{name}: line {problem.line}: {problem}") from None
        if not isinstance(data, dict):
            raise RecordingError(f"{name}: keys and values are needed, such as 'tick: 0.05'")
        return data

    @cached_property
    def configs(self) -> dict[int, dict[str, Any]]:
        """Configuration of each fishd, by its number in the recording, from 0.

        A fishd that ended before it was asked has no entry. Raises `RecordingError`.
        """
        return {number: self.settings_of(number) for number in self._yaml}

    @cached_property
    def ticks(self) -> list[Tick]:
        """All ticks, in the order of arrival; raises `RecordingError`."""
        return self._decoded("tick", Tick)

    @cached_property
    def events(self) -> list[Event]:
        """All events, including marks and changes of parameters; raises `RecordingError`."""
        return self._decoded("event", Event)

    @cached_property
    def statuses(self) -> list[Status]:
        """All statuses, one per second; none for a run in virtual time. Raises `RecordingError`."""
        return self._decoded("status", Status)

    def messages(self) -> Iterator[Tick | Event | Status]:
        """Yield all messages in the order of arrival; raise `RecordingError`."""
        iterators: dict[str, Iterator[Tick | Event | Status]] = {
            "tick": iter(self.ticks),
            "event": iter(self.events),
            "status": iter(self.statuses),
        }
        for entry in self.entries:
            yield next(iterators[entry.topic])

    @cached_property
    def times(self) -> list[float]:
        """Time of each message, in the order of arrival, since the first tick [s].

        It is that of fishd's monotonic clock, which no step of the unix clock moves. Raises
        `RecordingError`.
        """
        begin = self.entries[0].log_time if self.entries else 0
        times = [(entry.log_time - begin) * 1e-9 for entry in self.entries]
        topics = [entry.topic for entry in self.entries]
        first = times[topics.index("tick")] if "tick" in topics else 0.0
        return [time - first for time in times]

    def times_of(self, topic: str) -> list[float]:
        """Return the time of each message of a topic, such as `tick`, as in `times` [s]."""
        pairs = zip(self.entries, self.times, strict=True)
        return [time for entry, time in pairs if entry.topic == topic]

    @property
    def gaps(self) -> list[Gap]:
        """Gaps, in which ticks are missing."""
        return self._tally.gaps

    @cached_property
    def summary(self) -> Summary:
        """Summary of what the file contains.

        Its lost ticks include those that were in the file when the recording ended.
        """
        summary = self._tally.summary
        if not self._ends:
            return summary
        lost = sum(end.lost_ticks + end.ticks for end in self._ends) - summary.ticks
        return replace(summary, lost_ticks=max(summary.lost_ticks, lost))

    @property
    def stated_summary(self) -> Summary | None:
        """Summary that a finished, undamaged file of one recording states of itself; else None.

        The index of the file must contain the stated numbers of messages.
        """
        is_whole = self.finished and not (self.is_damaged or self._appended or self._missing_chunks)
        if not (is_whole and self.about and len(self._ends) == 1):
            return None
        counts = count_messages(self._ends[0])
        is_same = all(self._indexed[topic] == counts[topic] for topic in COUNTED_TOPICS)
        return self._ends[0] if is_same else None

    @cached_property
    def damaged(self) -> int | None:
        """Number of ticks that the file has lost; None if unknown. Raises `RecordingError`.

        Those between two ticks are in `gaps`, too.
        """
        if self.recorded_ticks is not None:
            return max(0, self.recorded_ticks - len(self.ticks))
        lost = 0
        for index in set(self._damages):
            before, after = self.ticks[:index][-1:], self.ticks[index : index + 1]
            if not (before and after and before[0].seq < after[0].seq):
                return None
            lost += after[0].seq - before[0].seq - 1
        return lost

    @property
    def recorded_ticks(self) -> int | None:
        """Number of ticks when the recording ended; None if unknown."""
        return None if self._recorded is None else self._recorded["tick"]

    @property
    def problem(self) -> str:
        """Difference between the file and what was recorded, in words; empty if there is none.

        It is `damaged: 10 ticks lost`, with the reason if known, or `not as recorded: 840 ticks
        instead of 1200`; of a repaired file, what was so before. Raises `RecordingError`.
        """
        if self.is_damaged:
            reason = f" ({self.damage_reason})" if self.damage_reason else ""
            lost = self.damaged
            ticks = "an unknown number of ticks" if lost is None else _format_count(lost, "tick")
            return f"damaged: {ticks} lost{reason}"
        if differences := self._differences():
            return f"not as recorded: {'; '.join(differences)}"
        return find_repaired_problem(self.reason)

    @property
    def is_as_recorded(self) -> bool:
        """Whether the file is undamaged, and has what it had when the recording ended."""
        return not self.is_damaged and not self._differences()

    def _differences(self) -> list[str]:
        """Return in words how the file differs from what it was when the recording ended."""
        held, recorded = self._held, self._recorded
        differences = [
            f"{_format_count(held[topic], message)} instead of {recorded[topic]}"
            for topic, message in COUNTED_TOPICS.items()
            if recorded is not None and held[topic] != recorded[topic]
        ]
        if self._repeated:
            differences.append("repeated messages are read once")
        if self._appended:
            differences.append(self._appended)
        if not self.about:
            differences.append(
                "its metadata are missing, which mcap filter keeps with --include-metadata and "
                "--include-attachments"
            )
        return differences

    @property
    def _held(self) -> Counter[str]:
        """Number of messages in the file by topic, the repeated ones included."""
        held = Counter(entry.topic for entry in self.entries)
        held[IMAGE_TOPIC], held[TAIL_TOPIC] = len(self.frame_heads), len(self.tails)
        return held + self._repeated

    @property
    def _recorded(self) -> Counter[str] | None:
        """Number of messages by topic when the recording ended; None if unknown.

        Without metadata of the end, it is that of the index at the end of the file.
        """
        if not self._ends:
            return self._indexed - self._repeated if self._indexed else None
        total = Counter[str]()
        for end in self._ends:
            total.update(count_messages(end))
        return total

    @cached_property
    def _tally(self) -> Tally:
        tally = Tally()
        for about in self.daemons:
            tally.set_daemon(about)
        for message, time in zip(self.messages(), self.times, strict=True):
            tally.add(message, time)
        for head in self.frame_heads:
            tally.frame(head)
        for _ in self.tails:
            tally.tail()
        return tally

    def frames(self) -> Iterator[RecordedFrame]:
        """Yield the frames of a camera, in the order of arrival, read on demand.

        These are the frames of `frame_heads`, even if a recording in progress has more by now.
        Raise `RecordingError`, and `MissingPackage` without OpenCV (extra: camera).
        """
        for payload in islice(self._images(), len(self.frame_heads)):
            try:
                yield decode_frame(payload)
            except RecordingError as error:
                raise RecordingError(f"{self.path}: {error}") from None

    def _images(self) -> Iterator[bytes]:
        for topic, record in self.records():
            if topic == IMAGE_TOPIC and isinstance(record, Message):
                yield record.data

    def records(self) -> Iterator[tuple[str, McapRecord | Damaged | Appended | Repeated]]:
        """Yield all records as `read_records` does, messages with their topics.

        `Repeated` replaces a message that is in the file again, as after a merge with a copy. Raise
        `RecordingError`.
        """
        known = set[int]()
        for record in read_records(self.path, with_messages=self._with_messages):
            topic = ""
            if isinstance(record, Channel):
                self._topics[record.id] = record.topic
            elif isinstance(record, Message):
                topic = self._topics.get(record.channel_id, "")
                key = hash((topic, record.log_time, record.data))
                if key in known:
                    yield topic, Repeated()
                    continue
                known.add(key)
            yield topic, record

    def frame(self) -> "DataFrame":
        """Return the ticks as a table: see `ticks_to_frame`; raise `RecordingError`.

        The additional column `elapsed` is the time since the first tick, as in `times` [s]. With
        fin angles of a camera, `fin_angle` and `fin_angle_uncertainty` are theirs at the ticks.
        """
        names: set[str] = set()
        for tick in self.ticks:
            names.update(tick.quantities or ())
            if len(names) > MAX_COLUMNS:
                raise RecordingError(
                    f"{self.path}: its controllers have more than {MAX_COLUMNS} quantities, too "
                    "many for a table"
                )
        table = ticks_to_frame(self.ticks).assign(elapsed=self.times_of("tick"))
        if self.tails:
            from fishd.recording.fin_angle import interpolate  # needs numpy

            times = [tick.time for tick in self.ticks]
            table["fin_angle"], table["fin_angle_uncertainty"] = interpolate(self.tails, times)
        return table

    def _scan(self) -> None:
        ticks = 0
        for topic, record in self.records():
            self.finished = isinstance(record, Footer)
            if isinstance(record, Message):
                if topic == IMAGE_TOPIC:
                    self.frame_heads.append(self._decode_seen(topic, decode_head, record.data))
                elif topic == TAIL_TOPIC:
                    self.tails.append(self._decode_seen(topic, _decode_tail, record.data))
                elif topic in CHANNELS:
                    self.entries.append(Entry(topic, record.data, record.log_time))
                    ticks += topic == "tick"
            elif isinstance(record, Repeated):
                self._repeated[topic] += 1
            elif isinstance(record, Damaged):
                self._damages.append(ticks)
                self._note_damage(record.reason)
            elif isinstance(record, Appended):
                self._appended = f"{_format_count(record.size, 'byte')} after its end are not read"
                if record.is_recording:
                    self._appended += f": another recording, which tail -c {record.size} extracts"
            elif isinstance(record, Chunk):
                self._missing_chunks -= 1
            elif isinstance(record, Statistics):
                self._missing_chunks += record.chunk_count
                for number, count in record.channel_message_counts.items():
                    self._indexed[self._topics.get(number, "")] += count
            elif isinstance(record, Metadata):
                self._take_metadata(record.name, record.metadata)
            elif isinstance(record, Attachment):
                try:
                    self._take_attachment(record.name, record.data)
                except ValueError as error:  # also msgspec.DecodeError
                    self._note_damage(f"{text.quoted(record.name)}: {text.error_message(error)}")
        if not self.about and not self.entries and self._with_messages:
            why = f": {self.damage_reason}" if self.damage_reason else ""
            raise RecordingError(f"{self.path} is an MCAP file, but not a recording of fishd{why}")

    def _note_damage(self, reason: str) -> None:
        self.is_damaged = True
        self.damage_reason = self.damage_reason or reason

    def _decode_seen(self, topic: str, decode: Callable[[bytes], T], payload: bytes) -> T:
        try:
            return decode(payload)
        except msgspec.DecodeError as error:
            raise RecordingError(
                f"{self.path}: a {COUNTED_TOPICS[topic]} of the camera cannot be read: {error}"
            ) from None

    def _take_metadata(self, name: str, data: dict[str, str]) -> None:
        if name == "fishd.run":
            self.about = data | read_note(self.path)
            if (layout := data.get("format", str(FORMAT))) != str(FORMAT):
                raise RecordingError(
                    f"{self.path}: its layout is {text.quoted(layout)}, and this fishd reads "
                    f"layout {FORMAT}: it was recorded by another version, "
                    f"{text.quoted(data.get('version', ''))}"
                )
        elif name == "fishd.daemon":
            self.daemons.append(data)
        elif name == "fishd.end":
            self.reason, end = data.get("reason", ""), from_metadata(data)
            if end is not None and end not in self._ends:
                self._ends.append(end)

    def _take_attachment(self, name: str, data: bytes) -> None:
        if name == CONFIG_ATTACHMENT:
            number = self.daemons[-1].get("number", "") if self.daemons else ""
            if not (number.isdecimal() and len(number) <= MAX_DIGITS):
                raise ValueError("the number of its fishd is unknown")
            self._yaml[int(number)] = data
        elif name == CALIBRATIONS_ATTACHMENT:
            self.calibrations.append(decoder(Calibrations)(data))

    def _decoded(self, topic: str, kind: type[T]) -> list[T]:
        decode = decoder(kind)
        try:
            return [decode(entry.payload) for entry in self.entries if entry.topic == topic]
        except msgspec.DecodeError as error:
            version = self.about.get("version", "unknown")
            raise RecordingError(
                f"{self.path}: a message '{topic}' of fishd {version} cannot be read by this one: "
                f"{error}"
            ) from None


def read(path: str | os.PathLike[str]) -> "DataFrame":
    """Return the ticks of a recording as a table: a row per tick, a column per field of `Tick`.

    All values are in SI units. Raise `RecordingError`, and `MissingPackage` without pandas (extra:
    lab).
    """
    return open_run(path).frame()


def count_messages(end: Summary) -> Counter[str]:
    """Return the number of messages by topic in the summary at the end of a recording."""
    return Counter(
        {"tick": end.ticks, "event": end.events, IMAGE_TOPIC: end.frames, TAIL_TOPIC: end.tails}
    )


def find_repaired_problem(reason: str) -> str:
    """Return what a recovery states of the file that it repaired; empty if it lost nothing known.

    reason: reason of the end of a recording
    """
    is_problem = reason.startswith(RECOVERED) and reason != UNFINISHED_REASON
    return text.line(reason) if is_problem else ""


def _format_count(number: int, word: str) -> str:
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def open_run(path: str | os.PathLike[str], *, with_messages: bool = True) -> Run:
    """Open a recording, finished or not; raise `RecordingError`.

    with_messages: whether messages are read, or only what the file states of itself
    """
    return Run(Path(path), with_messages=with_messages)
