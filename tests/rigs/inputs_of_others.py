"""Small files as other programs, spreadsheets and power cuts leave them; none is of others."""

import heapq
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from msgspec.structs import replace

from rigs.mcap_records import MAGIC, Record, join, split
from rigs.recordings import record_run, swum, write

FILES: dict[str, Callable[[Path], bytes]] = {}
"""Functions that make the files from the path of a good recording, by name."""
TICKS = 60
"""Ticks of the good recording; ten messages are in each chunk but the first, which has one."""
PRIVATE, FUTURE = (0x80, b"of another program"), (0x3F, b"of a later MCAP")
"""Records that a reader has to skip."""


def file(make: Callable[[Path], bytes]) -> Callable[[Path], bytes]:
    FILES[make.__name__.replace("_", "-") + ".mcap"] = make
    return make


def write_all(folder: Path) -> None:
    """Write all files into a folder."""
    good = record_run(swum(), folder / "good", flush_every=10)
    for name, make in FILES.items():
        (folder / name).write_bytes(make(good))


class Copy:
    """Copy of recordings by the library of MCAP, as its own command line tool makes it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("wb")
        self._writer = Writer(self._file, 2**22, CompressionType.ZSTD)
        self._writer.start()
        self._channels: dict[str, int] = {}

    def add(self, record: McapRecord, channel: Channel | None, schema: Schema | None) -> None:
        """Add a message of a channel, or another record."""
        writer = self._writer
        if isinstance(record, Message):
            assert channel
            assert schema
            if channel.topic not in self._channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                number = writer.register_channel(channel.topic, "json", number)
                self._channels[channel.topic] = number
            times = (record.log_time, record.data, record.publish_time, record.sequence)
            writer.add_message(self._channels[channel.topic], *times)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            times = (record.create_time, record.log_time)
            writer.add_attachment(*times, record.name, record.media_type, record.data)

    def content(self) -> bytes:
        """Finish the copy and return it."""
        self._writer.finish()
        self._file.close()
        content = self._path.read_bytes()
        self._path.unlink()
        return content


def read(path: Path) -> Iterator[tuple[McapRecord, Channel | None, Schema | None]]:
    """Yield the records of a recording, messages with their channels and schemas."""
    channels: dict[int, Channel] = {}
    schemas: dict[int, Schema] = {}
    with path.open("rb") as source:
        for record in StreamReader(source).records:
            channel = None
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
            yield record, channel, schemas[channel.schema_id] if channel else None


def filtered(
    good: Path, keep: Callable[[str, Message], bool], *, with_metadata: bool = True
) -> bytes:
    copy = Copy(good.with_suffix(".copy"))
    for record, channel, schema in read(good):
        if isinstance(record, Message):
            if channel and keep(channel.topic, record):
                copy.add(record, channel, schema)
        elif with_metadata:
            copy.add(record, channel, schema)
    return copy.content()


def merged(*paths: Path) -> bytes:
    copy = Copy(paths[0].with_suffix(".copy"))
    for path in paths:
        for record, channel, schema in read(path):
            if not isinstance(record, Message):
                copy.add(record, channel, schema)
    messages = [[item for item in read(path) if isinstance(item[0], Message)] for path in paths]
    for item in heapq.merge(*messages, key=lambda item: item[0].log_time):  # type: ignore[attr-defined]
        copy.add(*item)
    return copy.content()


def chunks(records: list[Record]) -> list[int]:
    return [index for index, (opcode, _) in enumerate(records) if opcode == Opcode.CHUNK]


def with_opcode(records: list[Record], opcode: int) -> list[Record]:
    """Return the records with another opcode of the third chunk."""
    at = chunks(records)[2]
    return [*records[:at], (opcode, records[at][1]), *records[at + 1 :]]


def is_end(record: Record) -> bool:
    return record[0] == Opcode.METADATA and b"fishd.end" in record[1][:20]


@file
def filtered_by_time(good: Path) -> bytes:
    return filtered(good, lambda topic, message: topic != "tick" or 10 < message.sequence <= 40)


@file
def filtered_by_topic(good: Path) -> bytes:
    return filtered(good, lambda topic, _: topic == "tick")


@file
def filtered_without_metadata(good: Path) -> bytes:
    return filtered(good, lambda *_: True, with_metadata=False)


@file
def merged_with_a_copy(good: Path) -> bytes:
    return merged(good, good)


@file
def merged_with_another(good: Path) -> bytes:
    ticks = [
        replace(tick, t=tick.t + 99.0, time=tick.time + 99.0) for tick in swum(1.0).recorder.ticks
    ]
    other = write(good.with_name("other"), ticks)
    content = merged(good, other)
    other.unlink()
    return content


@file
def copied_to_the_last_message(good: Path) -> bytes:
    return filtered(good, lambda *_: True)


@file
def with_records_of_others(good: Path) -> bytes:
    records = [part for record in split(good.read_bytes()) for part in (record, PRIVATE, FUTURE)]
    return join(records[:-2])  # nothing follows the footer


@file
def with_a_chunk_of_an_unknown_opcode(good: Path) -> bytes:
    return join(with_opcode(split(good.read_bytes()), Opcode.CHUNK ^ 0x55))


@file
def with_a_chunk_of_a_private_opcode(good: Path) -> bytes:
    return join(with_opcode(split(good.read_bytes()), Opcode.CHUNK ^ 0x80))


@file
def with_an_unknown_chunk_and_no_end(good: Path) -> bytes:
    records = [record for record in split(good.read_bytes()) if not is_end(record)]
    return join(with_opcode(records, Opcode.CHUNK ^ 0x80))


@file
def half_and_then_zeros(good: Path) -> bytes:
    records, content = split(good.read_bytes()), good.read_bytes()
    at = chunks(records)[3]
    begin = len(join(records[:at])) - len(MAGIC)
    middle = begin + len(records[at][1]) // 2
    return content[:middle] + bytes(len(content) - middle)


@file
def whole_chunks_and_then_zeros(good: Path) -> bytes:
    records, content = split(good.read_bytes()), good.read_bytes()
    begin = len(join(records[: chunks(records)[3]])) - len(MAGIC)
    return content[:begin] + bytes(len(content) - begin)


@file
def followed_by_another(good: Path) -> bytes:
    return good.read_bytes() * 2


@file
def followed_by_zeros(good: Path) -> bytes:
    return good.read_bytes() + bytes(512)


@file
def empty(_: Path) -> bytes:
    return b""


@file
def zeros(_: Path) -> bytes:
    return bytes(4096)


def swum_table() -> np.ndarray:
    """Return a table of time [s], F_x [N], F_y [N] and φ_c [rad] of a fish that swam, as rows."""
    rig = swum(12.0)
    rows = [(tick.time, tick.fx, tick.fy, tick.phi_c) for tick in rig.recorder.ticks]
    return np.array(rows)


def as_text(rows: np.ndarray, separator: str = ",", head: str = "", decimal: str = ".") -> str:
    lines = [separator.join(f"{x:.9g}".replace(".", decimal) for x in row) for row in rows]
    return "\n".join(([head] if head else []) + lines) + "\n"
