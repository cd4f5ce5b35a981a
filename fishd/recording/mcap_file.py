"""Reader of an MCAP file, record by record, that skips damaged parts and accepts a cut-off end."""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
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
_OPCODES = {int(code) for code in Opcode}
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


def read_records(path: Path) -> Iterator[McapRecord | Damaged]:
    """Yield schemas, channels, messages, metadata, attachments and the footer, in their order.

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


def read_metadata(path: Path) -> dict[str, dict[str, str]] | None:
    """Return the metadata by name, the last of each, of a finished, undamaged file; else None.

    This takes a tenth of the time that the messages would take. Raise like `read_records`.
    """
    entries: dict[str, dict[str, str]] = {}
    last: McapRecord | Damaged | None = None
    expand = _Expander(path)
    for _, last in _read_outer_records(path):
        if isinstance(last, Metadata):
            entries[last.name] = last.metadata
        elif isinstance(last, Chunk):
            try:
                content = expand(last)
            except RecordingError:
                raise
            except _PARSE_ERRORS:
                return None
            if zlib.crc32(content) != last.uncompressed_crc:
                return None
        elif isinstance(last, Damaged):
            return None
    return entries if isinstance(last, Footer) else None


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
    offset = 0
    while offset < len(content):
        opcode, length = _HEAD.unpack_from(content, offset)
        offset += _HEAD.size
        if length > len(content) - offset:
            raise EndOfFile
        if opcode in (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA):
            record = _parse_record(opcode, content[offset : offset + length])
            assert record is not None
            yield record
        offset += length


def _damage_reason(error: Exception) -> str:
    return str(error) if isinstance(error, _Implausible) else ""


def _format_megabytes(size: int) -> str:
    return f"{size / 2**20:.0f} MB"


def _read_outer_records(path: Path) -> Iterator[tuple[int, McapRecord | Damaged]]:
    """Yield position and content of each record outside of chunks, including the chunks."""
    try:
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise RecordingError(f"{path} is not an MCAP file")
            size = os.fstat(file.fileno()).st_size
            offset = len(_MAGIC)
            while offset < size:
                opcode, length, body = _read_record(file, offset, size)
                if body is None:
                    next_offset = _resume(file, offset + 1, size)
                    if next_offset is None:
                        return  # the file was cut off here
                    yield offset, Damaged(offset, _length_problem(opcode, length, size))
                    offset = next_offset
                    continue
                try:
                    record = _parse_record(opcode, body)
                except _PARSE_ERRORS as error:
                    why = _damage_reason(error)
                    yield offset, Damaged(offset, why)
                else:
                    if record is not None:
                        yield offset, record
                    if isinstance(record, Footer):
                        return
                offset += _HEAD.size + len(body)
    except RecordingError:
        raise
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from None


def _read_record(file: IO[bytes], offset: int, size: int) -> tuple[int, int, bytes | None]:
    """Return opcode, length and content of the record there; no content if it is invalid."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return 0, 0, None
    opcode, length = _HEAD.unpack(head)
    if opcode not in _OPCODES or length > min(MAX_RECORD_BYTES, size - offset - _HEAD.size):
        return opcode, length, None
    return opcode, length, file.read(length)


def _length_problem(opcode: int, length: int, size: int) -> str:
    """Return the problem of a record with an excessive length; empty for other problems."""
    if opcode in _OPCODES and MAX_RECORD_BYTES < length < size:
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
    """Return a record; None for kinds that are not needed, such as those of the index."""
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
        case Opcode.CHUNK | Opcode.METADATA | Opcode.SCHEMA | Opcode.CHANNEL | Opcode.FOOTER:
            record = _KINDS[opcode].read(stream)
        case _:
            return None
    return record


class _StrictStream(ReadDataStream):
    """Stream that raises `EndOfFile` if a record has fewer bytes than it claims."""

    def read(self, length: int) -> bytes:
        """Read exactly this many bytes."""
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


_KINDS: dict[int, type[Chunk | Metadata | Schema | Channel | Footer]] = {
    Opcode.CHUNK: Chunk,
    Opcode.METADATA: Metadata,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.FOOTER: Footer,
}
