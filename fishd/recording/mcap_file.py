"""Reads an MCAP file record by record, past what is damaged, to wherever it was cut off."""

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
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Footer,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from zstandard import ZstdError

from fishd.core.errors import RecordingError

MAX_RECORD = 2**26
"""Longest record that is read, and longest content of a chunk, a thousand times that of those that
`RunWriter` makes; what claims more is damaged [bytes]."""
MAX_EXPANSION = 100
"""The chunks of a file hold at most this many times its length; those of `RunWriter` hold ten
times as much where a noiseless fish rests, and less else."""
MIN_CONTENT = 2**22
"""Content of chunks that a file may have, however short it is [bytes]."""

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
"""Opcode and length, which every record begins with."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, log time and publish time of a message."""
_FOOTER = _HEAD.size + 20
"""Length of the footer, which is the last record of a finished file [bytes]."""
_FOOTER_HEAD = _HEAD.pack(Opcode.FOOTER, 20)
_OPCODES = {int(code) for code in Opcode}
_AGAIN = re.compile(rb"\x06.{36}\x04\0\0\0zstd|\x0c.{7}\0.\0\0\0fishd\.", re.DOTALL)
"""A chunk, or metadata of fishd, by which one finds one's way again behind damaged bytes."""
_FIRST_WINDOW, _WINDOW, _OVERLAP = 2**12, 2**20, 64
"""Bytes that are searched at once: at first, at most, and of these twice."""
_WRONG = (
    McapError, ZstdError, struct.error, ValueError, OverflowError, MemoryError, RuntimeError
)  # fmt: skip
"""What the parsers raise for damaged bytes; RuntimeError is that of lz4."""


class _Implausible(ValueError):
    """What is wrong with a record, in words for people."""


class Damaged(NamedTuple):
    """Stands for bytes that cannot be read."""

    offset: int
    """Where they begin in the file."""
    reason: str = ""
    """What is wrong with them; empty where their meaning is not known."""


def records(path: Path) -> Iterator[McapRecord | Damaged]:
    """Schemas, channels, messages, metadata, attachments and the footer, as they come.

    A file that was cut off ends with its last whole chunk. Raises `RecordingError` where it cannot
    be read, is not an MCAP file, or expands beyond `MAX_EXPANSION`.
    """
    expand = _Expander(path)
    for offset, record in _outer(path):
        if isinstance(record, Chunk):
            try:
                content = expand(record)
                if record.uncompressed_crc not in (0, zlib.crc32(content)):
                    raise ValueError("the checksum of a chunk is wrong")
                yield from _breakup(content)
            except RecordingError:
                raise
            except _WRONG as error:
                yield Damaged(offset, _reason(error))
        else:
            yield record


def metadata(path: Path) -> dict[str, dict[str, str]] | None:
    """The metadata by name, the last of each, of a file that is finished and whole; else None.

    It takes a tenth of the time that the messages would take. Raises as `records` does.
    """
    entries: dict[str, dict[str, str]] = {}
    last: McapRecord | Damaged | None = None
    expand = _Expander(path)
    for _, last in _outer(path):
        if isinstance(last, Metadata):
            entries[last.name] = last.metadata
        elif isinstance(last, Chunk):
            try:
                content = expand(last)
            except RecordingError:
                raise
            except _WRONG:
                return None
            if zlib.crc32(content) != last.uncompressed_crc:
                return None
        elif isinstance(last, Damaged):
            return None
    return entries if isinstance(last, Footer) else None


class _Expander:
    """Returns the content of chunks, and never allocates more than a recording may need."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            length = path.stat().st_size
        except OSError as error:
            raise RecordingError(f"{path} cannot be read: {error.strerror}") from None
        self._left = max(MIN_CONTENT, MAX_EXPANSION * length)
        self._decompress = zstandard.ZstdDecompressor().decompress

    def __call__(self, chunk: Chunk) -> bytes:
        """Return the content; raises one of `_WRONG`, and `RecordingError` beyond all limits."""
        size = chunk.uncompressed_size
        if size > MAX_RECORD:
            raise _Implausible(
                f"a chunk claims {_megabytes(size)}, {_megabytes(MAX_RECORD)} at most"
            )
        if chunk.compression == "zstd":
            claimed = zstandard.frame_content_size(chunk.data)
            if claimed not in (-1, size):  # it would be allocated; -1 where none is claimed
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
            # A size of 0 would stand for any.
            content = self._decompress(chunk.data, max_output_size=size) if size else b""
        elif chunk.compression == "lz4":
            content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        else:
            raise _Implausible("a chunk has a compression that is not known")
        return content


def _breakup(content: bytes) -> Iterator[McapRecord]:
    """The records in the content of a chunk; raises one of `_WRONG`."""
    offset = 0
    while offset < len(content):
        opcode, length = _HEAD.unpack_from(content, offset)
        offset += _HEAD.size
        if length > len(content) - offset:
            raise EndOfFile
        if opcode in (Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA):
            record = _parsed(opcode, content[offset : offset + length])
            assert record is not None
            yield record
        offset += length


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, _Implausible) else ""


def _megabytes(size: int) -> str:
    return f"{size / 2**20:.0f} MB"


def _outer(path: Path) -> Iterator[tuple[int, McapRecord | Damaged]]:
    """Records outside of chunks, the chunks among them, and where each begins."""
    try:
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise RecordingError(f"{path} is no MCAP file")
            size = os.fstat(file.fileno()).st_size
            offset = len(_MAGIC)
            while offset < size:
                opcode, length, body = _read(file, offset, size)
                if body is None:
                    again = _resume(file, offset + 1, size)
                    if again is None:
                        return  # it was cut off here
                    yield offset, Damaged(offset, _too_long(opcode, length, size))
                    offset = again
                    continue
                try:
                    record = _parsed(opcode, body)
                except _WRONG as error:
                    why = _reason(error)
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


def _read(file: IO[bytes], offset: int, size: int) -> tuple[int, int, bytes | None]:
    """Opcode, length and content of the record there; no content where none can be."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return 0, 0, None
    opcode, length = _HEAD.unpack(head)
    if opcode not in _OPCODES or length > min(MAX_RECORD, size - offset - _HEAD.size):
        return opcode, length, None
    return opcode, length, file.read(length)


def _too_long(opcode: int, length: int, size: int) -> str:
    """What is wrong with a record that is not read, where its length is to blame."""
    if opcode in _OPCODES and MAX_RECORD < length < size:
        return f"a record of {_megabytes(length)}, {_megabytes(MAX_RECORD)} at most"
    return ""


def _resume(file: IO[bytes], offset: int, size: int) -> int | None:
    """Where the next intact record begins; None if all the rest is damaged."""
    searched = _FIRST_WINDOW
    while offset < size:
        file.seek(offset)
        window = file.read(searched)
        for match in _AGAIN.finditer(window):
            where = offset + match.start()
            _, length = _HEAD.unpack_from(window, match.start())
            if length <= min(MAX_RECORD, size - where - _HEAD.size):
                return where
        offset += searched - _OVERLAP
        searched = min(2 * searched, _WINDOW)
    end = max(0, size - _FOOTER - len(_MAGIC))
    file.seek(end)
    tail = file.read()
    return end if tail.startswith(_FOOTER_HEAD) and tail.endswith(_MAGIC) else None


def _parsed(opcode: int, body: bytes) -> McapRecord | None:
    """The record; None for one of which nothing is needed, such as those of the index."""
    stream = _StrictStream(BytesIO(body))
    match opcode:
        case Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
            data = body[_MESSAGE_HEAD.size :]
            record: McapRecord = Message(channel, log_time, data, publish_time, sequence)
        case Opcode.ATTACHMENT:
            (sum_of_all,) = struct.unpack_from("<I", body, len(body) - 4)
            if sum_of_all not in (0, zlib.crc32(memoryview(body)[:-4])):
                raise ValueError("the checksum of an attachment is wrong")
            record = Attachment.read(stream)
        case Opcode.CHUNK | Opcode.METADATA | Opcode.SCHEMA | Opcode.CHANNEL | Opcode.FOOTER:
            record = _KINDS[opcode].read(stream)
        case _:
            return None
    return record


class _StrictStream(ReadDataStream):
    """Reads as many bytes as a record claims to have, or raises `EndOfFile`."""

    def read(self, length: int) -> bytes:
        """Read this many bytes, and not fewer."""
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
