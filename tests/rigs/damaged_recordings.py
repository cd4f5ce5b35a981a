"""Random damage to a good recording.

Bytes flip, parts are cut out, inserted, repeated and spliced, lengths change. The same happens
within chunks with corrected checksums, so that damaged data reaches the parsers of messages.
"""

import random
import struct
from collections.abc import Callable

import zstandard
from mcap.opcode import Opcode

from rigs.mcap_records import Record, attachment, chunk, chunk_content, join, split

LENGTHS = (0, 1, 0x7F, 0xFFFF, 2**31 - 1, 2**32 - 1, 2**33, 2**63 - 1, 2**64 - 1)
"""Values that a damaged length may claim, beside random ones."""
WORDS = (b"1e308", b"-1e308", b"null", b"[]", b'"\\ud800"', b"9" * 30, b'"\x1b[0m"', b"{}", b"")
"""Values that a damaged message may have."""


def flip(dice: random.Random, content: bytes) -> bytes:
    """Change one to ten bytes."""
    changed = bytearray(content)
    for _ in range(dice.randint(1, 10)):
        changed[dice.randrange(len(changed))] = dice.randrange(256)
    return bytes(changed)


def cut(dice: random.Random, content: bytes) -> bytes:
    """Leave out the end, or a part in the middle."""
    begin = dice.randrange(len(content))
    end = len(content) if dice.random() < 0.5 else dice.randrange(begin, len(content))
    return content[:begin] + content[end:]


def insert(dice: random.Random, content: bytes) -> bytes:
    """Insert random bytes, or a copy of a part."""
    at, length = dice.randrange(len(content)), dice.randint(1, 2000)
    begin = dice.randrange(len(content))
    block = dice.randbytes(length) if dice.random() < 0.5 else content[begin : begin + length]
    return content[:at] + block + content[at:]


def lengthen(dice: random.Random, content: bytes) -> bytes:
    """Change the length of a record, or a number within one that looks like a length."""
    records = split(content)
    offset = 8
    starts = []
    for _, body in records:
        starts.append((offset + 1, "<Q"))
        if len(body) > 8:
            starts.append((offset + 9 + dice.randrange(min(60, len(body) - 7)), "<Q"))
            starts.append((offset + 9 + dice.randrange(min(60, len(body) - 3)), "<I"))
        offset += 9 + len(body)
    at, form = dice.choice(starts)
    mask = 2 ** (8 * struct.calcsize(form)) - 1
    value = dice.choice((*LENGTHS, dice.getrandbits(dice.randint(1, 64)))) & mask
    changed = bytearray(content)
    struct.pack_into(form, changed, at, value)
    return bytes(changed)


def splice(dice: random.Random, content: bytes) -> bytes:
    """Exchange, repeat, leave out and move whole records."""
    records = split(content)
    for _ in range(dice.randint(1, 5)):
        at, to = (dice.randrange(len(records)) for _ in range(2))
        match dice.randrange(3):
            case 0:
                records.insert(to, records[at])
            case 1:
                records[at], records[to] = records[to], records[at]
            case _ if len(records) > 5:
                del records[at]
    return join(records)


def corrupt_content(dice: random.Random, content: bytes) -> bytes:
    """Change the content of a chunk or an attachment, with the valid checksum."""
    records = split(content)
    places = [i for i, (opcode, _) in enumerate(records) if opcode == Opcode.CHUNK]
    places += [i for i, (opcode, _) in enumerate(records) if opcode == Opcode.ATTACHMENT]
    at = dice.choice(places)
    records[at] = _corrupt(dice, *records[at])
    return join(records)


def _corrupt(dice: random.Random, opcode: int, body: bytes) -> Record:
    damage = dice.choice((flip, cut, insert, replace_value, replace_value))
    if opcode == Opcode.ATTACHMENT:
        (name,) = struct.unpack_from("<I", body, 16)
        begin = 20 + name
        (media,) = struct.unpack_from("<I", body, begin)
        data = body[begin + 4 + media + 8 : -4]
        return attachment(body[20:begin].decode(), damage(dice, data))
    inner = chunk_content(body)
    match dice.randrange(4):
        case 0:  # the length of a message
            ends = [inner.index(b'{"t":') - 31 + 1]
            changed = bytearray(inner)
            struct.pack_into("<Q", changed, max(0, ends[0]), dice.choice(LENGTHS))
            return chunk(bytes(changed))
        case 1:  # another compression, or none
            name = dice.choice(("", "lz4", "zstd", "odd"))
            data = dice.choice((inner, zstandard.compress(inner), dice.randbytes(200)))
            return chunk(inner, name, data=data)
        case _:
            return chunk(damage(dice, inner))


def replace_value(dice: random.Random, content: bytes) -> bytes:
    """Replace a value of JSON or YAML."""
    colons = [i for i in range(len(content)) if content[i : i + 1] == b":"]
    if not colons:
        return flip(dice, content)
    begin = dice.choice(colons) + 1
    end = begin
    while end < len(content) and content[end : end + 1] not in (b",", b"}", b"\n"):
        end += 1
    return content[:begin] + b" " + dice.choice(WORDS) + content[end:]


KINDS: dict[str, Callable[[random.Random, bytes], bytes]] = {
    "bytes are changed": flip,
    "cut off, or a part is missing": cut,
    "random bytes or a copy of a part are inserted": insert,
    "a length or a number in a record is changed": lengthen,
    "records are repeated, exchanged or left out": splice,
    "content is changed, checksums are right": corrupt_content,
}
"""Ways to damage the content of a file."""
