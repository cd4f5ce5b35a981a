"""Reads an MCAP file record by record, past what is damaged, to wherever it was cut off."""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
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
from mcap.stream_reader import breakup_chunk
from zstandard import ZstdError

from fishd.core.errors import RecordingError

LONGEST_RECORD = 2**28
"""No record of a recording is longer; what says so is damaged [bytes]."""

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
"""Opcode and length, which every record begins with."""
_FOOTER = _HEAD.size + 20
"""Length of the footer, which is the last record of a finished file [bytes]."""
_FOOTER_HEAD = _HEAD.pack(Opcode.FOOTER, 20)
_OPCODES = {int(code) for code in Opcode}
_AGAIN = re.compile(rb"\x06.{36}\x04\0\0\0zstd|\x0c.{7}\0.\0\0\0fishd\.", re.DOTALL)
"""A chunk, or metadata of fishd, by which one finds one's way again behind damaged bytes."""
_WINDOW, _OVERLAP = 2**20, 64
"""Bytes that are searched at once, and of these twice."""
_WRONG = (McapError, ZstdError, struct.error, ValueError, OverflowError, MemoryError)
"""What the parsers raise for damaged bytes."""


class Damaged(NamedTuple):
    """Stands for bytes that cannot be read."""

    offset: int
    """Where they begin in the file."""


def records(path: Path) -> Iterator[McapRecord | Damaged]:
    """Schemas, channels, messages, metadata, attachments and the footer, as they come.

    A file that was cut off ends with its last whole chunk. Raises `RecordingError` where it cannot
    be read, or is no MCAP file.
    """
    for offset, record in _outer(path):
        if isinstance(record, Chunk):
            try:
                yield from breakup_chunk(record, validate_crc=True)
            except _WRONG:
                yield Damaged(offset)
        else:
            yield record


def metadata(path: Path) -> dict[str, dict[str, str]] | None:
    """The metadata by name, the last of each, of a file that is finished and whole; else None.

    It takes a tenth of the time that the messages would take. Raises as `records` does.
    """
    found: dict[str, dict[str, str]] = {}
    last: McapRecord | Damaged | None = None
    decompressor = zstandard.ZstdDecompressor()
    for _, last in _outer(path):
        if isinstance(last, Metadata):
            found[last.name] = last.metadata
        elif isinstance(last, Chunk):
            if last.compression != "zstd":  # damaged, or written by another program
                return None
            try:
                content = decompressor.decompress(last.data, last.uncompressed_size)
            except _WRONG:
                return None
            if zlib.crc32(content) != last.uncompressed_crc:
                return None
        elif isinstance(last, Damaged):
            return None
    return found if isinstance(last, Footer) else None


def _outer(path: Path) -> Iterator[tuple[int, McapRecord | Damaged]]:
    """Records outside of chunks, the chunks among them, and where each begins."""
    try:
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise RecordingError(f"{path} is no MCAP file")
            size = os.fstat(file.fileno()).st_size
            offset = len(_MAGIC)
            while offset < size:
                opcode, body = _read(file, offset, size)
                if body is None:
                    again = _resume(file, offset + 1, size)
                    if again is None:
                        return  # it was cut off here
                    yield offset, Damaged(offset)
                    offset = again
                    continue
                try:
                    record = _parsed(opcode, body)
                except _WRONG:
                    yield offset, Damaged(offset)
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


def _read(file: IO[bytes], offset: int, size: int) -> tuple[int, bytes | None]:
    """Opcode and content of the record there; no content where none can be."""
    file.seek(offset)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return 0, None
    opcode, length = _HEAD.unpack(head)
    if opcode not in _OPCODES or length > min(LONGEST_RECORD, size - offset - _HEAD.size):
        return opcode, None
    return opcode, file.read(length)


def _resume(file: IO[bytes], offset: int, size: int) -> int | None:
    """Where the next intact record begins; None if all the rest is damaged."""
    while offset < size:
        file.seek(offset)
        window = file.read(_WINDOW)
        for found in _AGAIN.finditer(window):
            where = offset + found.start()
            _, length = _HEAD.unpack_from(window, found.start())
            if length <= min(LONGEST_RECORD, size - where - _HEAD.size):
                return where
        offset += _WINDOW - _OVERLAP
    end = max(0, size - _FOOTER - len(_MAGIC))
    file.seek(end)
    tail = file.read()
    return end if tail.startswith(_FOOTER_HEAD) and tail.endswith(_MAGIC) else None


def _parsed(opcode: int, body: bytes) -> McapRecord | None:
    """The record; None for one of which nothing is needed, such as those of the index."""
    stream = ReadDataStream(BytesIO(body))
    match opcode:
        case Opcode.MESSAGE:
            record: McapRecord = Message.read(stream, len(body))
        case Opcode.ATTACHMENT:
            (sum_of_all,) = struct.unpack_from("<I", body, len(body) - 4)
            if sum_of_all not in (0, zlib.crc32(body[:-4])):
                raise ValueError("the checksum of an attachment is wrong")
            record = Attachment.read(stream)
        case Opcode.CHUNK | Opcode.METADATA | Opcode.SCHEMA | Opcode.CHANNEL | Opcode.FOOTER:
            record = _KINDS[opcode].read(stream)
        case _:
            return None
    return record


_KINDS: dict[int, type[Chunk | Metadata | Schema | Channel | Footer]] = {
    Opcode.CHUNK: Chunk,
    Opcode.METADATA: Metadata,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.FOOTER: Footer,
}
