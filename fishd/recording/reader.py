"""Reader of recordings, also of unfinished ones: a kill leaves complete chunks."""

import copy
import os
from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import msgspec
from mcap.records import Attachment, Channel, Footer, Message, Metadata
from msgspec.structs import replace

from fishd.config import Config, adopt
from fishd.core import strict_yaml, text
from fishd.core.dataframes import ticks_to_frame
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError, RecordingError
from fishd.core.old_names import rename_keys, rename_message
from fishd.core.protocol import Calibrations
from fishd.core.signals import Event, Status, Tick
from fishd.recording.axis import Axis
from fishd.recording.images import IMAGE_TOPIC, FrameHead, RecordedFrame, decode_frame, decode_head
from fishd.recording.mcap_file import Damaged, read_records
from fishd.recording.part_file import PART_SUFFIX, SUFFIX
from fishd.recording.summary import Gap, Summary, Tally, from_metadata, place
from fishd.recording.writer import (
    AXIS_FORMAT,
    CALIBRATIONS_ATTACHMENT,
    CHANNELS,
    CONFIG_ATTACHMENT,
    PRESENT_NAMES_FORMAT,
)

if TYPE_CHECKING:
    from pandas import DataFrame

T = TypeVar("T")

TOPICS = dict(enumerate((*CHANNELS, IMAGE_TOPIC), start=1))
"""Topics by the channel numbers of `RunWriter`, for a file whose channel records are damaged."""

MAX_DIGITS = 9
"""Maximum number of digits of the number of a fishd in a recording."""
MAX_COLUMNS = 100
"""Maximum number of quantities of controllers in one table; each takes one number per tick."""


class Entry(NamedTuple):
    """One message of a recording."""

    topic: str
    """`tick`, `event` or `status`."""
    payload: bytes
    """JSON, exactly as fishd sent it; that of an older fishd has the present names."""
    log_time: int
    """Time of the message in the file [ns]."""


class Run:
    """A recording, as `open_run` reads it; its messages are decoded on demand."""

    def __init__(self, path: Path) -> None:
        """Raises `RecordingError` if the file cannot be read, or is not a recording."""
        self.path = path
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
        self._ended: Summary | None = None
        """Summary at the end of the recording."""
        self._damages: list[int] = []
        """Number of ticks before each damaged part that was skipped."""
        self.damage_reason = ""
        """Description of the first damage; empty if unknown."""
        self.entries: list[Entry] = []
        """All messages of fishd, in the order of arrival."""
        self.is_timed = True
        """Whether ticks that have been read have monotonic times; else its times are unix times."""
        self.frame_heads: list[FrameHead] = []
        """Metadata of the frames of a camera, in the order of arrival."""
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
        """All ticks, in the order of arrival; raises `RecordingError`.

        If an older fishd gave them no monotonic time, their `time` is their unix time.
        """
        ticks = self._decoded("tick", Tick)
        self.is_timed = len(ticks) < 2 or any(tick.time for tick in ticks)
        return ticks if self.is_timed else [replace(tick, time=tick.t) for tick in ticks]

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
        if self._format < AXIS_FORMAT:
            axis = Axis()
            times = [place(axis, message) for message in self.messages()]
        else:
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

    @property
    def summary(self) -> Summary:
        """Summary of the recording."""
        return self._tally.summary

    @property
    def is_damaged(self) -> bool:
        """Whether there are parts that cannot be read."""
        return bool(self._damages)

    @cached_property
    def damaged(self) -> int:
        """Known number of ticks in unreadable parts; raises `RecordingError`.

        Those between two ticks are in `gaps`, too.
        """
        if not self._damages:
            return 0
        if self._ended is not None:
            return max(0, self._ended.ticks - len(self.ticks))
        neighbours = [self.ticks[index - 1 : index + 1] for index in set(self._damages) if index]
        return sum(max(0, pair[1].seq - pair[0].seq - 1) for pair in neighbours if len(pair) == 2)

    @cached_property
    def _tally(self) -> Tally:
        tally = Tally()
        for about in self.daemons:
            tally.set_daemon(about)
        for message, time in zip(self.messages(), self.times, strict=True):
            tally.add(message, time)
        for head in self.frame_heads:
            tally.frame(head)
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
        topics = dict(TOPICS)
        for record in read_records(self.path):
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message) and topics.get(record.channel_id) == IMAGE_TOPIC:
                yield record.data

    def frame(self) -> "DataFrame":
        """Return the ticks as a table: see `ticks_to_frame`; raise `RecordingError`.

        The additional column `elapsed` is the time since the first tick, as in `times` [s].
        """
        names: set[str] = set()
        for tick in self.ticks:
            names.update(tick.quantities or ())
            if len(names) > MAX_COLUMNS:
                raise RecordingError(
                    f"{self.path}: its controllers have more than {MAX_COLUMNS} quantities, too "
                    "many for a table"
                )
        return ticks_to_frame(self.ticks).assign(elapsed=self.times_of("tick"))

    def _scan(self) -> None:
        topics = dict(TOPICS)
        ticks = 0
        for record in read_records(self.path):
            self.finished = isinstance(record, Footer)
            if isinstance(record, Message):
                topic = topics.get(record.channel_id, "")
                if topic == IMAGE_TOPIC:
                    self._take_frame(self._with_present_names("frame", record.data))
                elif topic in CHANNELS:
                    payload = self._with_present_names(topic, record.data)
                    self.entries.append(Entry(topic, payload, record.log_time))
                    ticks += topic == "tick"
            elif isinstance(record, Damaged):
                self._damages.append(ticks)
                self.damage_reason = self.damage_reason or record.reason
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata):
                self._take_metadata(record.name, record.metadata)
            elif isinstance(record, Attachment):
                try:
                    self._take_attachment(record.name, record.data)
                except ValueError as error:  # also msgspec.DecodeError
                    self._damages.append(ticks)
                    why = f"{text.quoted(record.name)}: {text.error_message(error)}"
                    self.damage_reason = self.damage_reason or why
        if not self.about and not (self.is_damaged and self.entries):
            why = f": {self.damage_reason}" if self.damage_reason else ""
            raise RecordingError(f"{self.path} is an MCAP file, but not a recording of fishd{why}")

    def _with_present_names(self, kind: str, payload: bytes) -> bytes:
        """Return a message; one with old names gets the present ones."""
        return payload if self._format >= PRESENT_NAMES_FORMAT else rename_message(kind, payload)

    @property
    def _format(self) -> int:
        """Version of the layout; 0 if it is not known."""
        number = self.about.get("format", "")
        return int(number) if number.isdecimal() and len(number) <= MAX_DIGITS else 0

    def _take_frame(self, payload: bytes) -> None:
        try:
            self.frame_heads.append(decode_head(payload))
        except msgspec.DecodeError as error:
            raise RecordingError(
                f"{self.path}: a frame of the camera cannot be read: {error}"
            ) from None

    def _take_metadata(self, name: str, data: dict[str, str]) -> None:
        if name == "fishd.run":
            self.about = data
        elif name == "fishd.daemon":
            self.daemons.append(rename_keys("daemon", data))
        elif name == "fishd.end":
            self.reason, self._ended = data.get("reason", ""), from_metadata(data)

    def _take_attachment(self, name: str, data: bytes) -> None:
        if name == CONFIG_ATTACHMENT:
            number = self.daemons[-1].get("number", "") if self.daemons else ""
            if not (number.isdecimal() and len(number) <= MAX_DIGITS):
                raise ValueError("the number of its fishd is unknown")
            self._yaml[int(number)] = data
        elif name == CALIBRATIONS_ATTACHMENT:
            payload = self._with_present_names("calibrations", data)
            self.calibrations.append(decoder(Calibrations)(payload))

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


def open_run(path: str | os.PathLike[str]) -> Run:
    """Open a recording, finished or not; raise `RecordingError`."""
    return Run(Path(path))
