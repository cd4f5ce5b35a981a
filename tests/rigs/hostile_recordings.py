"""Generated files that pretend to be recordings; none is large."""

import base64
import json
import struct
import zlib
from collections.abc import Callable, Iterable
from typing import Any

import cv2
import lz4.frame
import msgspec
import numpy as np
import zstandard
from mcap.opcode import Opcode

from fishd.core.signals import Event
from rigs.mcap_records import (
    MAGIC,
    Record,
    attachment,
    chunk,
    chunk_content,
    join,
    message,
    metadata,
    pack,
    split,
    text,
)

TICK, EVENT, STATUS, CAMERA = 1, 2, 3, 4
"""Numbers of the channels of `RunWriter`."""
CLAIM = 8 * 2**30
"""Size that a hostile file states [bytes]."""
ODD = '\x1b[31m<script>alert(1)</script>\x9b\u202e$\\frac{"&'
"""Text that a terminal, a page or matplotlib could interpret as commands."""

Good = list[Record]
"""Records of a good recording; its first chunk comes after metadata and configuration."""
FILES: dict[str, Callable[[Good], bytes]] = {}
"""Functions that make the files, by name."""


def file(make: Callable[[Good], bytes]) -> Callable[[Good], bytes]:
    FILES[make.__name__.replace("_", "-")] = make
    return make


def with_first_chunk(good: Good, *instead: Record) -> bytes:
    """Return the good file with its first chunk replaced."""
    at = next(index for index, (opcode, _) in enumerate(good) if opcode == Opcode.CHUNK)
    return join([*good[:at], *instead, *good[at + 1 :]])


def with_more(good: Good, *more: Record) -> bytes:
    """Return the good file with more records at the end of its data."""
    at = next(index for index, (opcode, _) in enumerate(good) if opcode == Opcode.DATA_END)
    return join([*good[:at], *more, *good[at:]])


def with_config(good: Good, yaml: bytes) -> bytes:
    """Return the good file with another configuration."""
    return join(
        [
            attachment("config.yaml", yaml) if b"config.yaml" in body[:40] else (opcode, body)
            for opcode, body in good
            if opcode == Opcode.ATTACHMENT or b"config.yaml" not in body[:40]
        ]
    )


def with_messages(good: Good, channel: int, messages: Iterable[Any]) -> bytes:
    """Return the good file with more messages, each plain data or bytes."""
    payloads = (data if isinstance(data, bytes) else json.dumps(data).encode() for data in messages)
    return with_more(good, chunk(b"".join(message(channel, payload) for payload in payloads)))


def tick_of(good: Good, **changes: Any) -> dict[str, Any]:
    """Return the changed first tick of the good file as plain data."""
    chunks = (chunk_content(body) for opcode, body in good if opcode == Opcode.CHUNK)
    payloads = (
        body[22:]
        for content in chunks
        for opcode, body in split(MAGIC + content + MAGIC)
        if opcode == Opcode.MESSAGE and body[0] == TICK
    )
    return {**msgspec.json.decode(next(payloads), type=dict[str, Any]), **changes}


@file
def zstd_frame_of_8_gb(good: Good) -> bytes:
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", CLAIM) + b"\x03\x00\x00" + b"x" * 99
    return with_first_chunk(good, chunk(b"", data=frame, size=1000))


@file
def zstd_frame_of_unknown_size(good: Good) -> bytes:
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    frame = compressor.compress(bytes(2**27)) + compressor.flush()
    return with_first_chunk(good, chunk(b"", data=frame, size=1000))


@file
def lz4_frame_of_8_gb(good: Good) -> bytes:
    frame = bytearray(lz4.frame.compress(b"x" * 1000, store_size=True))
    frame[6:14] = struct.pack("<Q", CLAIM)
    return with_first_chunk(good, chunk(b"", "lz4", data=bytes(frame), size=1000))


@file
def lz4_frame_of_128_mb_in_a_chunk_of_1_kb(good: Good) -> bytes:
    frame = lz4.frame.compress(bytes(2**27), store_size=False)
    return with_first_chunk(good, chunk(b"", "lz4", data=frame, size=1000))


@file
def chunk_whose_data_are_longer_than_it(good: Good) -> bytes:
    opcode, body = chunk(b"x" * 99)
    return with_first_chunk(good, (opcode, body[:36] + struct.pack("<Q", 2**62) + body[44:]))


@file
def texts_longer_than_their_record(good: Good) -> bytes:
    long = struct.pack("<I", 2**32 - 1)
    return with_more(
        good,
        (Opcode.METADATA, text("fishd.run") + long),
        (Opcode.METADATA, text("fishd.run") + text(long + b"x")),
        (Opcode.CHANNEL, struct.pack("<HH", 1, 1) + text("tick") + text("json") + long),
        (Opcode.SCHEMA, struct.pack("<H", 1) + text("x") + text("json") + long + b"{}"),
        attachment("config.yaml", b"tick: 0.05", length=2**62),
    )


@file
def an_index_of_everything_at_the_end_of_the_world(good: Good) -> bytes:
    huge = b"\xff" * 64
    names = ("MESSAGE_INDEX", "CHUNK_INDEX", "ATTACHMENT_INDEX", "STATISTICS", "METADATA_INDEX")
    indexes = [(getattr(Opcode, name), huge) for name in (*names, "SUMMARY_OFFSET")]
    return join([*good[:-1], *indexes, (Opcode.FOOTER, huge[:20])])


@file
def thousands_of_beginnings_of_chunks(good: Good) -> bytes:
    beginning = pack(Opcode.CHUNK, bytes(28) + text("zstd"), 60)
    return join(good[:6]) + (b"\xff" + beginning) * 5_000


@file
def aliases(good: Good) -> bytes:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 30)]
    return with_config(good, "\n".join(lines).encode())


def picture(good: Good, data: str, **more: Any) -> bytes:
    head = {"t": 1.0, "time": 1.0, "available": 1.0, "seq": 9, "session": ODD}
    stamp = {"timestamp": {"sec": 1, "nsec": 0}, "data": data}
    return with_messages(good, CAMERA, [{**head, **stamp, **more}])


@file
def frame_of_4_gb(good: Good) -> bytes:
    size = struct.pack(">II", 65535, 65535)
    head = b"IHDR" + size + b"\x08\x00\x00\x00\x00"
    part = struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))
    return picture(good, base64.b64encode(b"\x89PNG\r\n\x1a\n" + part + bytes(99)).decode())


@file
def frame_with_damaged_pixels(good: Good) -> bytes:
    _, png = cv2.imencode(".png", np.arange(64, dtype=np.uint8).reshape(8, 8))
    return picture(good, base64.b64encode(png.tobytes().replace(b"IDAT", b"IDAT\x00")).decode())


@file
def numbers_that_no_fish_has(good: Good) -> bytes:
    changes = [{name: 1e308 * s} for name in ("fx", "phi_c", "sample_age_ms", "t") for s in (1, -1)]
    ticks = [tick_of(good, seq=61 + i, **c) for i, c in enumerate(changes)]
    return with_messages(good, TICK, ticks)


@file
def ten_thousand_quantities(good: Good) -> bytes:
    quantities = {f"q{i}{ODD}": 1.0 for i in range(10_000)}
    return with_messages(good, TICK, [tick_of(good, seq=61, quantities=quantities)])


@file
def texts_that_are_commands(good: Good) -> bytes:
    tick = tick_of(good, seq=61, controller=ODD, mode="running", quantities={ODD: 1.0, "=1+1": 2})
    events = [
        {"t": 1.0, "level": "info", "kind": "mark", "message": words, "data": {ODD: ODD}}
        for words in (ODD, "=HYPERLINK(0)", "@SUM(1)", "+1", "-1", "\t=1", "a\nb")
    ]
    return with_more(
        good,
        metadata("fishd.run", {"run": ODD, "note": ODD, "subject": ODD, "started": ODD}),
        metadata("fishd.daemon", {"number": "0", "force_unit": ODD}),
        chunk(b"".join(message(EVENT, json.dumps(event).encode()) for event in events)),
        chunk(message(TICK, json.dumps(tick).encode())),
    )


@file
def deep_json(good: Good) -> bytes:
    deep = b"[" * 100_000 + b"]" * 100_000
    event = b'{"t":1,"level":"info","kind":"mark","message":"","data":{"a":' + deep + b"}}"
    return with_messages(good, EVENT, [event])


@file
def events_that_do_not_say_what(good: Good) -> bytes:
    event = {"t": 1.0, "level": "info", "message": ""}
    return with_messages(
        good,
        EVENT,
        [
            {**event, "kind": "controller", "data": {}},
            {**event, "kind": "parameters", "data": {"parameters": [ODD]}},
        ],
    )


@file
def parameters_that_no_controller_has(good: Good) -> bytes:
    data = {"controller": "swing", "parameters": {ODD: ODD}}
    event = {"t": 1.0, "level": "info", "kind": "controller", "message": "", "data": data}
    tick = message(TICK, json.dumps(tick_of(good, seq=61)).encode())
    return with_more(good, chunk(message(EVENT, json.dumps(event).encode()) + tick))


@file
def thousands_of_events(good: Good) -> bytes:
    events = (Event(1.0, "info", "mark", f"again {number}") for number in range(5000))
    return with_messages(good, EVENT, map(msgspec.json.encode, events))


@file
def cut_off(good: Good) -> bytes:
    whole = join(good)
    return whole[: len(whole) // 2]


FILES |= {
    "zstd-chunk-of-8-gb": lambda good: with_first_chunk(good, chunk(b"x" * 1000, size=CLAIM)),
    "lz4-chunk-of-8-gb": lambda good: with_first_chunk(
        good, chunk(b"", "lz4", data=lz4.frame.compress(b"x"), size=CLAIM)
    ),
    "chunks-of-zeros": lambda good: with_more(good, *[chunk(bytes(2**25))] * 40),
    "half-a-million-messages": lambda good: with_more(
        good,
        chunk(b"".join(message(TICK, struct.pack("<I", n)) for n in range(2**22 // 35))),
    ),
    "record-of-8-exabytes": lambda good: (
        join(good[:6]) + pack(Opcode.CHUNK, b"x" * 99, 2**63) + join(good[6:])
    ),
    "messages-longer-than-their-chunk": lambda good: with_first_chunk(
        good, chunk(pack(Opcode.MESSAGE, b"x" * 99, 2**62))
    ),
    "yaml-that-contains-itself": lambda good: with_config(good, b"&a {plant: *a, robot: *a}"),
    "deep-yaml": lambda good: with_config(good, b"[" * 2_000_000),
    "deep-but-short-yaml": lambda good: with_config(good, b"a: " + b"[" * 30_000),
    "yaml-with-tags": lambda good: with_config(
        good, b"tick: !!bool maybe\nname: !!python/object/apply:os.system [exit 1]"
    ),
    "yaml-of-bytes": lambda good: with_config(good, bytes(range(256))),
    "another-robot": lambda good: with_config(
        good, b"robot: pi\ntick: 1.0e-300\nestimator: {kind: observer}"
    ),
    "frame-without-data": lambda good: picture(good, ""),
    "frame-without-a-head": lambda good: with_messages(good, CAMERA, [{"t": ODD}]),
    "a-number-of-400-digits": lambda good: with_messages(good, TICK, [tick_of(good, seq=10**400)]),
    "daemons-without-a-number": lambda good: with_more(
        good,
        metadata("fishd.daemon", {}),
        attachment("config.yaml", b"tick: 0.05"),
        metadata(
            "fishd.daemon", {"number": "9" * 5000, "lowest_angle": "nan", "highest_angle": ODD}
        ),
        attachment("config.yaml", b"tick: 0.05"),
        attachment("calibrations.json", b"[" * 100_000),
    ),
    "limits-that-are-no-numbers": lambda good: with_more(
        good, metadata("fishd.daemon", {"number": "0", "lowest_angle": ODD})
    ),
    "empty": lambda good: b"",
    "nothing-but-magic": lambda good: MAGIC,
    "nothing-but-records-of-nothing": lambda good: join([(Opcode.DATA_END, b"")] * 10_000),
}
