"""MCAP files built record by record, also with valid checksums and invalid content."""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import zstandard
from mcap.opcode import Opcode

from fishd.config import Config
from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.camera_frames import FrameHead
from fishd.core.protocol import Calibrations
from fishd.core.signals import Event, Percentiles, Status, Timing
from fishd.lab.simulation import simulate
from fishd.recording import RunWriter, open_run

MAGIC = b"\x89MCAP0\r\n"
Record = tuple[int, bytes]
"""Record as opcode and content."""


def text(words: str | bytes) -> bytes:
    """Return a text with its length before it."""
    content = words.encode() if isinstance(words, str) else words
    return struct.pack("<I", len(content)) + content


def pack(opcode: int, body: bytes, length: int | None = None) -> bytes:
    """Return a record; length: stated length [bytes]."""
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


def chunk(
    content: bytes,
    compression: str = "zstd",
    *,
    data: bytes | None = None,
    size: int | None = None,
) -> Record:
    """Return a chunk of this content, with the valid checksum.

    data: data in the file; by default the content compressed by zstd
    size: stated size of the content [bytes]
    """
    compressed = zstandard.ZstdCompressor().compress(content) if data is None else data
    claimed = len(content) if size is None else size
    head = struct.pack("<QQQI", 0, 0, claimed, zlib.crc32(content))
    length = struct.pack("<Q", len(compressed))
    return Opcode.CHUNK, head + text(compression) + length + compressed


def message(channel: int, payload: bytes, t: float = 1.0) -> bytes:
    """Return a message of a chunk."""
    nanoseconds = round(t * 1e9)
    return pack(
        Opcode.MESSAGE, struct.pack("<HIQQ", channel, 0, nanoseconds, nanoseconds) + payload
    )


def attachment(name: str, data: bytes, length: int | None = None) -> Record:
    """Return an attachment with the valid checksum; length: stated length of its data [bytes]."""
    claimed = struct.pack("<Q", len(data) if length is None else length)
    body = struct.pack("<QQ", 0, 0) + text(name) + text("") + claimed + data
    return Opcode.ATTACHMENT, body + struct.pack("<I", zlib.crc32(body))


def metadata(name: str, entries: Mapping[str, str]) -> Record:
    """Return a metadata record."""
    content = b"".join(text(key) + text(value) for key, value in entries.items())
    return Opcode.METADATA, text(name) + text(content)


def split(content: bytes) -> list[Record]:
    """Return the records of an intact file."""
    records, offset = [], len(MAGIC)
    while offset < len(content) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", content, offset)
        records.append((opcode, content[offset + 9 : offset + 9 + length]))
        offset += 9 + length
    return records


def join(records: list[Record]) -> bytes:
    """Return a file of these records."""
    return MAGIC + b"".join(pack(*record) for record in records) + MAGIC


def chunk_content(body: bytes) -> bytes:
    """Return the content of an intact chunk of `RunWriter`."""
    return zstandard.decompress(body[8 + 8 + 8 + 4 + 4 + 4 + 8 :])


def write_good_recording(path: Path, seconds: float = 3.0) -> None:
    """Write a short recording with every kind of content."""
    config, extra = Config(), {"force_unit": "N", "lowest_angle": "-0.42", "highest_angle": "0.42"}
    with RunWriter(path.with_name(f"{path.stem}-ticks"), source="simulation") as writer:
        writer.describe(config, extra)
        simulate(config, "swing", {}, seconds, settle=1.0, publisher=writer)
    run = open_run(writer.path)
    writer.path.unlink()
    never = Percentiles(0.0, 0.0, 0.0, 0)
    with RunWriter(path, operator="Ada", subject="fish 3", note="stiff fin") as writer:
        writer.describe(config, extra)
        writer.calibrated(Calibrations(ForceCalibration(), None, ServoCalibration(), None, 1.0))
        for event in run.events:
            writer.event(event)
        for tick in run.ticks:
            writer.tick(tick)
            if tick.seq % 20 == 0:
                writer.flush()
                writer.event(Event(tick.t, "info", "mark", f"mark {tick.seq}"))
                writer.status(
                    Status(
                        tick.t, "1", 7, tick.time, tick.mode, None, tick.controller, {},
                        tick.servo_on, 0.0, 0.0, config.tick, 0.42, -0.42, 0.42, tick.seq, 0, 0,
                        Timing(never, never, {}), "simulated", (), {}, realtime=False, telemetry="",
                    )
                )  # fmt: skip
                head = FrameHead(tick.t, tick.time, tick.time, tick.seq // 20, "one", 0.01)
                writer.frame(head, np.full((8, 8), tick.seq % 251, np.uint8))
