"""Random damage to a good recording, which is then read by every verb that reads recordings.

Bytes flip, parts are cut out, inserted, repeated and spliced, lengths change. The same happens
within chunks with corrected checksums, so that damaged data reaches the parsers of messages. An
answer is wrong if it is a traceback, more than one line, or a line without the name of the file, or
if it takes more than 10 s of processor time, or more than 300 MB. `plot` draws one file of a
hundred, in another process; for the others its curves are computed. One file of ten is exported as
Parquet and listed as JSON. Exit status 1 where an answer was wrong.
"""

import math
import random
import resource
import shutil
import struct
import tempfile
import time
import traceback
from argparse import Namespace
from collections.abc import Callable, Iterable, Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import zstandard
from mcap.opcode import Opcode
from msgspec import Struct

from common.machine import machine
from common.mcap_records import (
    Record,
    attachment,
    chunk,
    chunk_content,
    join,
    split,
    write_good_recording,
)
from common.recording_verbs import (
    MAX_MEGABYTES,
    MAX_SECONDS,
    Outcome,
    find_mistakes,
    peak_memory,
    run_verb,
)
from common.report import Options, Report, progress, table
from fishd.core.errors import FishdError
from fishd.lab.run_traces import traces
from fishd.recording import open_run

MAX_ADDRESSES = 8 * 2**30
"""Limit of allocations, at which a file that claims 8 GB would end in a MemoryError [bytes]."""
OFTEN = "runs", "export --csv", "rerun", "replay", "recover"
SELDOM = "runs --json", "export --parquet"
DRAWN = ("plot",)
SELDOM_PERIOD, DRAWING_PERIOD = 10, 100
"""Number of files of which one is read by the verbs of `SELDOM`, and of `DRAWN`."""
GOOD_SECONDS = 2.0
"""Length of the good recording [s]."""
LENGTHS = (0, 1, 0x7F, 0xFFFF, 2**31 - 1, 2**32 - 1, 2**33, 2**63 - 1, 2**64 - 1)
"""Values that a damaged length may claim, beside random ones."""
WORDS = (b"1e308", b"-1e308", b"null", b"[]", b'"\\ud800"', b"9" * 30, b'"\x1b[0m"', b"{}", b"")
"""Values that a damaged message may have."""


class Kind(Struct, frozen=True):
    """A way to damage a file."""

    what: str
    damage: Callable[[random.Random, bytes], bytes]


class Result(Struct):
    """Result for the files that were damaged in one way."""

    what: str
    files: int = 0
    readable: int = 0
    """Files from which `export` wrote a table."""
    seconds: float = 0.0
    """Processor time of the slowest verb."""
    megabytes: float = 0.0
    """Peak memory of the process until then."""
    mistakes: int = 0


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


KINDS = (
    Kind("bytes are changed", flip),
    Kind("cut off, or a part is missing", cut),
    Kind("random bytes or a copy of a part are inserted", insert),
    Kind("a length or a number in a record is changed", lengthen),
    Kind("records are repeated, exchanged or left out", splice),
    Kind("content is changed, checksums are right", corrupt_content),
)


def read(file: Path, folder: Path, verbs: Sequence[str]) -> list[Outcome]:
    """Run these verbs on a file; without `plot`, compute its curves."""
    outcomes = []
    for verb in verbs:
        out = folder / "out"
        out.mkdir()
        copy = Path(shutil.copy(file, out)) if verb == "recover" else file
        outcomes.append(run_verb(verb, copy, out))
        shutil.rmtree(out)
    if not set(DRAWN) & set(verbs):
        outcomes.append(_compute_curves(file))
    return outcomes


def _compute_curves(file: Path) -> Outcome:
    begun, error = time.process_time(), ""
    try:
        traces(open_run(file))
    except FishdError:
        pass
    except Exception:
        error = traceback.format_exc()
    seconds = time.process_time() - begun
    return Outcome("curves", file.name, None if error else 0, "", error, seconds)


def verbs_for(number: int) -> tuple[str, ...]:
    """Return the verbs that read the file of this number, without those that draw."""
    return OFTEN if number // len(KINDS) % SELDOM_PERIOD else OFTEN + SELDOM


def try_all(
    numbers: Iterable[int], seed: int, draw: bool, deadline: float = math.inf
) -> tuple[list[Result], list[str]]:
    """Damage a good file once for each number, with the kinds in turn; return results and mistakes.

    draw: run the verbs that draw, instead of the others
    deadline: time of the end [s, monotonic clock]
    """
    results, wrong = [Result(kind.what) for kind in KINDS], []
    with tempfile.TemporaryDirectory(prefix="fishd-") as name:
        folder = Path(name)
        write_good_recording(folder / "good.mcap", GOOD_SECONDS)
        content = (folder / "good.mcap").read_bytes()
        file = folder / "files/run.mcap"
        file.parent.mkdir()
        for number in numbers:
            if time.monotonic() > deadline:
                break
            kind, result = KINDS[number % len(KINDS)], results[number % len(KINDS)]
            file.write_bytes(kind.damage(random.Random(f"{seed} {number}"), content))
            outcomes = read(file, folder, DRAWN if draw else verbs_for(number))
            result.files += 1
            result.readable += any(o.status == 0 for o in outcomes if o.verb in OFTEN[1:2] + DRAWN)
            result.seconds = max(result.seconds, *(outcome.seconds for outcome in outcomes))
            result.megabytes = max(result.megabytes, peak_memory())
            mistakes = [
                f"file {number}, {o.verb}: {m}: {o.err}" for o in outcomes for m in find_mistakes(o)
            ]
            result.mistakes += len(mistakes)
            wrong += mistakes
            if mistakes or number % 600 == 0:
                progress(f"file {number}", f"{peak_memory():.0f} MB", *mistakes)
    return results, wrong


def try_in_process(*arguments: Any) -> list[Result]:
    """Run `try_all` in another process, to measure the memory of these verbs."""
    with get_context("spawn").Pool(1, _limit_memory) as pool:
        return pool.apply(try_all, arguments)[0]


def _limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MAX_ADDRESSES, MAX_ADDRESSES))


OPTIONS: Options = {
    "--number": {"type": int, "default": 10_000, "help": "of damaged files; default 10000"},
    "--seed": {"type": int, "default": 3},
    "--minutes": {"type": float, "default": math.inf, "help": "end after this time"},
}


def measure(options: Namespace) -> Report:
    """Damage and read files; takes a quarter of an hour on an idle machine."""
    deadline = time.monotonic() + 60.0 * options.minutes
    numbers = range(options.number)
    drawn = [n for n in numbers if n // len(KINDS) % DRAWING_PERIOD == 0]
    (*of_plot,) = try_in_process(drawn, options.seed, True, deadline)
    results = try_in_process(numbers, options.seed, False, deadline)
    together = Result(
        "the same, drawn by `plot`",
        sum(result.files for result in of_plot),
        sum(result.readable for result in of_plot),
        max(result.seconds for result in of_plot),
        max(result.megabytes for result in of_plot),
        sum(result.mistakes for result in of_plot),
    )
    rows = [
        [
            result.what,
            str(result.files),
            str(result.readable),
            f"{result.seconds:.2f}",
            f"{result.megabytes:.0f}",
            str(result.mistakes),
        ]
        for result in (*results, together)
    ]
    head = (
        "damage to the file | files | still exported or drawn | slowest verb [s] | "
        "peak memory [MB] | wrong answers"
    )
    broken = any(
        result.mistakes or result.seconds > MAX_SECONDS or result.megabytes > MAX_MEGABYTES
        for result in (*results, together)
    )
    processor, cores = list(machine().values())[:2]
    words = f"Seed {options.seed}; seconds of processor time; {cores} cores of an {processor}."
    sections = {"reliability mutations": f"{table(head, rows)}\n\n{words}"}
    number = (
        f"{sum(result.mistakes for result in results)} wrong answers on "
        f"{sum(result.files for result in results)} files; slowest verb "
        f"{max(result.seconds for result in results):.2f} s, at most "
        f"{max(result.megabytes for result in (*results, together)):.0f} MB"
    )
    return Report(sections, [*results, together], broken=broken, number=number)
