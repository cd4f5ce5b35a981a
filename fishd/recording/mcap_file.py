"""Reader of an MCAP file, record by record, that skips damaged parts and accepts a cut-off end.

The library parses records and chunks. Its own reader would end at the first damaged byte, and
allocate whatever size a file claims.
"""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
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
from mcap.stream_reader import breakup_chunk, get_chunk_data_stream

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
_RESUME_PATTERN = re.compile(
    rb"\x06.{36}\x04\0\0\0zstd|\x0c.{7}\0.\0\0\0fishd\.|\x02\x14\0{7}.{20}" + re.escape(_MAGIC),
    re.DOTALL,
)
"""A chunk, metadata of fishd, or the footer: records at which reading resumes after damage."""
_WINDOW_BYTES, _OVERLAP_BYTES = 2**16, 64
"""Size of a part of the file that is searched at once, and the overlap of two such parts."""
_KINDS: dict[int, type[Attachment | Chunk | Metadata | Schema | Channel | Statistics | Footer]] = {
    Opcode.ATTACHMENT: Attachment,
    Opcode.CHUNK: Chunk,
    Opcode.METADATA: Metadata,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.STATISTICS: Statistics,
    Opcode.FOOTER: Footer,
}
_PARSE_ERRORS = (
    McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError, MemoryError,
    RuntimeError,
)  # fmt: skip
"""Errors of the parsers for damaged bytes; RuntimeError is that of lz4."""


class _Implausible(ValueError):
    """A record is implausible; the message is for the user."""


class Damaged(NamedTuple):
    """Placeholder of bytes that cannot be read."""

    reason: str = ""
    """Description of the damage; empty if unknown."""


class Appended(NamedTuple):
    """Placeholder, before the footer, of bytes that follow the end and are not read."""

    size: int
    """Number of bytes."""
    is_recording: bool
    """Whether another recording begins with them, as after `cat a.mcap b.mcap`."""


def read_records(
    path: Path, *, with_messages: bool = True
) -> Iterator[McapRecord | Damaged | Appended]:
    """Yield all records but those of the index in order, with the content of chunks in their place.

    A file that was cut off ends with its last complete chunk.

    with_messages: False to yield the chunks, whose content is checked in any case
    Raise `RecordingError` if the file cannot be read, is not an MCAP file, or expands beyond
    `MAX_EXPANSION`.
    """
    try:
        with path.open("rb") as file:
            left = max(MIN_CONTENT_BYTES, MAX_EXPANSION * os.fstat(file.fileno()).st_size)
            for record in _read_outer_records(path, file):
                if not isinstance(record, Chunk):
                    yield record
                    continue
                try:
                    left -= _check_size(record)
                    if left < 0:
                        raise RecordingError(
                            f"{path}: its chunks claim more than {MAX_EXPANSION} times the length "
                            "of the file: it is not a recording of fishd"
                        )
                    yield from _read_chunk(record, with_messages=with_messages)
                except _PARSE_ERRORS as error:
                    yield Damaged(str(error) if isinstance(error, _Implausible) else "")
    except RecordingError:
        raise
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from None


def read_first_metadata(path: Path) -> dict[str, str]:
    """Return the metadata at the beginning of a file; none if another record precedes them.

    Raise `RecordingError` if the file cannot be read, or is not an MCAP file.
    """
    record = next(read_records(path), None)
    return record.metadata if isinstance(record, Metadata) else {}


def _check_size(chunk: Chunk) -> int:
    """Return the size of the content of a chunk [bytes]; raise `_Implausible`."""
    size = chunk.uncompressed_size
    if size > MAX_RECORD_BYTES:
        raise _Implausible(
            f"a chunk claims {size / 2**20:.0f} MB, {MAX_RECORD_BYTES / 2**20:.0f} MB at most"
        )
    if chunk.compression == "zstd":
        claimed = zstandard.frame_content_size(chunk.data)
        if claimed not in (-1, size):  # the decoder would allocate it; -1: not given
            raise _Implausible(f"a zstd frame claims {claimed} bytes, its chunk {size}")
    elif chunk.compression not in ("", "lz4"):
        raise _Implausible("a chunk has an unknown compression")
    return size


def _read_chunk(chunk: Chunk, *, with_messages: bool) -> list[McapRecord]:
    """Return the content of a chunk of checked size, or that chunk; raise `_PARSE_ERRORS`."""
    checked = chunk
    if chunk.compression == "lz4":  # the library would decode it without a limit
        limit = chunk.uncompressed_size + 1
        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=limit)
        checked = replace(chunk, compression="", data=content)
    if with_messages:
        return breakup_chunk(checked, validate_crc=True)
    get_chunk_data_stream(checked, validate_crc=True)
    return [chunk]


def _read_outer_records(path: Path, file: IO[bytes]) -> Iterator[McapRecord | Damaged | Appended]:
    """Yield each record outside of chunks, including the chunks."""
    size = os.fstat(file.fileno()).st_size
    if size == 0:
        raise RecordingError(
            f"{path} is empty, as a power cut may leave a file; delete it, there is nothing to "
            "recover"
        )
    if file.read(len(_MAGIC)) != _MAGIC:
        raise RecordingError(f"{path} is not an MCAP file")
    offset: int | None = len(_MAGIC)
    while offset is not None and offset < size:
        file.seek(offset)
        head = file.read(_HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (head[0], 0)
        end = offset + _HEAD.size + length
        if not opcode or length > MAX_RECORD_BYTES or end > size:
            next_offset = _find_next_record(file, offset + 1, size)
            if next_offset is None and opcode and length <= MAX_RECORD_BYTES:
                return  # the file was cut off here
            yield Damaged()
            offset = next_offset
            continue
        try:
            record = _parse_record(opcode, file.read(length))
        except _PARSE_ERRORS:
            record = Damaged()
        if isinstance(record, Footer):
            if (appended := size - end - len(_MAGIC)) > 0:
                yield Appended(appended, file.read(2 * len(_MAGIC)) == 2 * _MAGIC)
            yield record
            return
        if record is not None:
            yield record
        offset = end


def _find_next_record(file: IO[bytes], offset: int, size: int) -> int | None:
    """Return the position of the next intact record; None if the rest is damaged."""
    while offset < size:
        file.seek(offset)
        window = file.read(_WINDOW_BYTES)
        for match in _RESUME_PATTERN.finditer(window):
            position = offset + match.start()
            _, length = _HEAD.unpack_from(window, match.start())
            if length <= min(MAX_RECORD_BYTES, size - position - _HEAD.size):
                return position
        offset += _WINDOW_BYTES - _OVERLAP_BYTES
    return None


def _parse_record(opcode: int, body: bytes) -> McapRecord | Damaged | None:
    """Return a record; None for kinds that are not needed, such as those of the index.

    MCAP reserves opcodes for its later versions and for other programs; a reader skips them.
    """
    stream = _StrictStream(BytesIO(body))
    if opcode == Opcode.MESSAGE:
        message: Message = Message.read(stream, len(body))
        return message
    if opcode == Opcode.ATTACHMENT:  # the library does not check them
        (checksum,) = struct.unpack_from("<I", body, len(body) - 4)
        if checksum not in (0, zlib.crc32(memoryview(body)[:-4])):
            return Damaged()
    kind = _KINDS.get(opcode)
    return kind.read(stream) if kind else None


class _StrictStream(ReadDataStream):
    """Stream that raises `EndOfFile` if a record has fewer bytes than it claims."""

    def read(self, length: int) -> bytes:
        """Read exactly this many bytes."""
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data
