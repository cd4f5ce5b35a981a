"""Reader of an MCAP file, record by record, that skips damaged parts and accepts a cut-off end."""

import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Footer,
    McapRecord,
    Message,
    Metadata,
    Schema,
    Statistics,
)  # fmt: skip
from zstandard import ZstdError

from fishd.core.errors import RecordingError

MAX_RECORD_BYTES = 2**26
"""Maximum size of a record and of the content of a chunk, a thousand times that by `RunWriter`; a
record that claims more is damaged [bytes]."""
MAX_EXPANSION = 100
"""Maximum ratio of the content of all chunks to the size of the file; with `RunWriter` it is at
most ten, for a noiseless fish at rest."""
MIN_CONTENT_BYTES = 2**22
"""Content of chunks that is permitted for a file of any size [bytes]."""

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
"""Opcode and length, at the beginning of every record."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, log time and publish time of a message."""
_FOOTER_BYTES = _HEAD.size + 20
"""Size of the footer, the last record of a finished file [bytes]."""
_FOOTER_HEAD = _HEAD.pack(Opcode.FOOTER, 20)
_RESUME_PATTERN = re.compile(rb"\x06.{36}\x04\0\0\0zstd|\x0c.{7}\0.\0\0\0fishd\.", re.DOTALL)
"""Beginning of a chunk or of metadata of fishd, at which reading resumes after damaged bytes."""
_FIRST_WINDOW_BYTES, _MAX_WINDOW_BYTES, _OVERLAP_BYTES = 2**12, 2**20, 64
"""Sizes of the search window for it: at first, at most, and the overlap of two windows [bytes]."""
_PARSE_ERRORS = (
    McapError, ZstdError, struct.error, ValueError, OverflowError, MemoryError, RuntimeError
)  # fmt: skip
"""Errors of the parsers for damaged bytes; RuntimeError is that of lz4."""


class _Implausible(ValueError):
    """A record is implausible; the message is for the user."""


class Damaged(NamedTuple):
    """Placeholder of bytes that cannot be read."""

    offset: int
    """Position of the first byte in the file."""
    reason: str = ""
    """Description of the damage; empty if unknown."""


class Appended(NamedTuple):
    """Placeholder, before the footer, of bytes that follow the end and are not read."""

    size: int
    """Number of bytes."""
    is_recording: bool
    """Whether another recording begins with them, as after `cat a.mcap b.mcap`."""


def read_records(path: Path) -> Iterator[McapRecord | Damaged | Appended]:
    """Yield all records but chunks and those of the index, and the content of chunks, in order.

    A file that was cut off ends with its last complete chunk. Raise `RecordingError` if the file
    cannot be read, is not an MCAP file, or expands beyond `MAX_EXPANSION`.
    """
    expand = _Expander(path)
    for offset, record in _read_outer_records(path):
        if isinstance(record, Chunk):
            try:
                content = expand(record)
                if record.uncompressed_crc not in (0, zlib.crc32(content)):
                    raise ValueError("the checksum of a chunk is wrong")
                yield from _split_chunk(content)
            except RecordingError:
                raise
            except _PARSE_ERRORS as error:
                yield Damaged(offset, _damage_reason(error))
        else:
            yield record


class Outline(NamedTuple):
    """Content of a finished, undamaged file, without its messages."""

    metadata: dict[str, dict[str, str]]
    """Metadata by name, the last of each."""
    messages: Counter[str]
    """Number of messages by topic, counted in the file itself."""


def read_outline(path: Path) -> Outline | None:
    """Return metadata and numbers of messages of a finished, undamaged file; else None.

    This takes a sixth of the time that the messages would take. Raise like `read_records`.
    """
    outline = Outline({}, Counter())
    topics: dict[int, str] = {}
    last: McapRecord | Damaged | Appended | None = None
    expand = _Expander(path)
    for _, last in _read_outer_records(path):
        if isinstance(last, Metadata):
            outline.metadata[last.name] = last.metadata
        elif isinstance(last, Channel):
            topics[last.id] = last.topic
        elif isinstance(last, Chunk):
            try:
                content = expand(last)
                if zlib.crc32(content) != last.uncompressed_crc:
                    return None
                _count_messages(content, topics, outline.messages)
            except RecordingError:
                raise
            except _PARSE_ERRORS:
                return None
        elif isinstance(last, Damaged | Appended | Message):
            return None
    return outline if isinstance(last, Footer) else None


def read_first_metadata(path: Path) -> dict[str, str]:
    """Return the metadata at the beginning of a file; none if another record precedes them.

    Raise `RecordingError` if the file cannot be read, or is not an MCAP file.
    """
    _, record = next(_read_outer_records(path), (0, None))
    return record.metadata if isinstance(record, Metadata) else {}


class _Expander:
    """Function that returns the content of chunks, with a limit on the memory that it allocates."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            length = path.stat().st_size
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror}") from None
        self._left = max(MIN_CONTENT_BYTES, MAX_EXPANSION * length)
        self._decompress = zstandard.ZstdDecompressor().decompress

    def __call__(self, chunk: Chunk) -> bytes:
        """Return the content; raise one of `_PARSE_ERRORS`, or `RecordingError` above the limit."""
        size = chunk.uncompressed_size
        if size > MAX_RECORD_BYTES:
            raise _Implausible(
                f"a chunk claims {_format_megabytes(size)}, {_format_megabytes(MAX_RECORD_BYTES)} "
                "at most"
            )
        if chunk.compression == "zstd":
            claimed = zstandard.frame_content_size(chunk.data)
            if claimed not in (-1, size):  # the decoder would allocate it; -1: not given
                raise _Implausible(f"a zstd frame claims {claimed} bytes, its chunk {size}")
        self._left -= size
        if self._left < 0:
            raise RecordingError(
                f"{self._path}: its chunks claim more than {MAX_EXPANSION} times the length of "
                "the file: it is not a recording of fishd"
            )
        content = self._content(chunk, size)
        if len(content) != size:
            raise _Implausible(f"a chunk claims {size} bytes and does not have them")
        return content

    def _content(self, chunk: Chunk, size: int) -> bytes:
        content: bytes
        if not chunk.compression:
            content = chunk.data
        elif chunk.compression == "zstd":
            # A size of 0 would mean no limit.
            content = self._decompress(chunk.data, max_output_size=size) if size else b""
        elif chunk.compression == "lz4":
            content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        else:
            raise _Implausible("a chunk has an unknown compression")
        return content


def _split_chunk(content: bytes) -> Iterator[McapRecord]:
    """Yield the records in the content of a chunk; raise one of `_PARSE_ERRORS`."""
    for opcode, begin, end in _find_records(content):
        if opcode in (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA):
            record = _parse_record(opcode, content[begin:end])
            assert record is not None
            yield record


def _count_messages(content: bytes, topics: dict[int, str], counts: Counter[str]) -> None:
    """Count the messages in the content of a chunk by topic; raise one of `_PARSE_ERRORS`.

    topics: topics by the numbers of their channels; those of the chunk are added
    """
    numbers: Counter[int] = Counter()
    for opcode, begin, end in _find_records(content):
        if opcode == Opcode.MESSAGE:
            numbers[int.from_bytes(content[begin : begin + 2], "little")] += 1
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_StrictStream(BytesIO(content[begin:end])))
            topics[channel.id] = channel.topic
    for number, count in numbers.items():
        counts[topics.get(number, "")] += count


def _find_records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of each record in a chunk; raise one of `_PARSE_ERRORS`."""
    begin, size = 0, len(content)
    while begin < size:
        opcode, length = _HEAD.unpack_from(content, begin)
        begin += _HEAD.size
        if length > size - begin:
            raise EndOfFile
        yield opcode, begin, begin + length
        begin += length


def _damage_reason(error: Exception) -> str:
    return str(error) if isinstance(error, _Implausible) else ""


def _format_megabytes(size: int) -> str:
    return f"{size / 2**20:.0f} MB"


def _read_outer_records(path: Path) -> Iterator[tuple[int, McapRecord | Damaged | Appended]]:
    """Yield position and content of each record outside of chunks, including the chunks."""
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size == 0:
                raise RecordingError(
                    f"{path} is empty, as a power cut may leave a file; delete it, there is "
                    "nothing to recover"
                )
            if file.read(len(_MAGIC)) != _MAGIC:
                raise RecordingError(f"{path} is not an MCAP file")
            offset = len(_MAGIC)
            while offset < size:
                opcode, length, body = _read_record(file, offset, size)
                if body is None:
                    next_offset = _resume(file, offset + 1, size)
                    if next_offset is None and opcode > 0 and length <= MAX_RECORD_BYTES:
                        return  # the file was cut off here
                    yield offset, Damaged(offset, _length_problem(length, size))
                    if next_offset is None:
                        return
                    offset = next_offset
                    continue
                try:
                    record = _parse_record(opcode, body)
                except _PARSE_ERRORS as error:
                    why = _damage_reason(error)
                    yield offset, Damaged(offset, why)
                else:
                    if isinstance(record, Footer):
                        end = offset + _HEAD.size + len(body) + len(_MAGIC)
                        if end < size:
                            file.seek(end)
                            is_recording = file.read(len(_MAGIC)) == _MAGIC
                            yield offset, Appended(size - end, is_recording)
                        yield offset, record
                        return
                    if record is not None:
                        yield offset, record
                offset += _HEAD.size + len(body)
    except RecordingError:
        raise
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from None


def _read_record(file: IO[bytes], offset: int, size: int) -> tuple[int, int, bytes | None]:
    """Return opcode, length and content of the record there; no content if it is invalid.

    At the cut-off end of a file, the head may be incomplete, too.
    """
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return head[0], 0, None
    opcode, length = _HEAD.unpack(head)
    if not opcode or length > min(MAX_RECORD_BYTES, size - offset - _HEAD.size):
        return opcode, length, None
    return opcode, length, file.read(length)


def _length_problem(length: int, size: int) -> str:
    """Return the problem of a record with an excessive length; empty for other problems."""
    if MAX_RECORD_BYTES < length < size:
        return (
            f"a record of {_format_megabytes(length)}, {_format_megabytes(MAX_RECORD_BYTES)} at "
            "most"
        )
    return ""


def _resume(file: IO[bytes], offset: int, size: int) -> int | None:
    """Return the position of the next intact record; None if the rest is damaged."""
    searched = _FIRST_WINDOW_BYTES
    while offset < size:
        file.seek(offset)
        window = file.read(searched)
        for match in _RESUME_PATTERN.finditer(window):
            position = offset + match.start()
            _, length = _HEAD.unpack_from(window, match.start())
            if length <= min(MAX_RECORD_BYTES, size - position - _HEAD.size):
                return position
        offset += searched - _OVERLAP_BYTES
        searched = min(2 * searched, _MAX_WINDOW_BYTES)
    end = max(0, size - _FOOTER_BYTES - len(_MAGIC))
    file.seek(end)
    tail = file.read()
    return end if tail.startswith(_FOOTER_HEAD) and tail.endswith(_MAGIC) else None


def _parse_record(opcode: int, body: bytes) -> McapRecord | None:
    """Return a record; None for kinds that are not needed, such as those of the index.

    MCAP reserves opcodes for its later versions and for other programs; a reader skips them.
    """
    stream = _StrictStream(BytesIO(body))
    match opcode:
        case Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
            data = body[_MESSAGE_HEAD.size :]
            record: McapRecord = Message(channel, log_time, data, publish_time, sequence)
        case Opcode.ATTACHMENT:
            (checksum,) = struct.unpack_from("<I", body, len(body) - 4)
            if checksum not in (0, zlib.crc32(memoryview(body)[:-4])):
                raise ValueError("the checksum of an attachment is wrong")
            record = Attachment.read(stream)
        case _:
            if opcode not in _KINDS:
                return None
            record = _KINDS[opcode].read(stream)
    return record


class _StrictStream(ReadDataStream):
    """Stream that raises `EndOfFile` if a record has fewer bytes than it claims."""

    def read(self, length: int) -> bytes:
        """Read exactly this many bytes."""
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


_KINDS: dict[int, type[Chunk | Metadata | Schema | Channel | Statistics | Footer]] = {
    Opcode.CHUNK: Chunk,
    Opcode.METADATA: Metadata,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.STATISTICS: Statistics,
    Opcode.FOOTER: Footer,
}
