"""Export of a recording as tables of ticks and events for other programs: CSV or Parquet."""

import itertools
import math
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pandas
import pyarrow
import pyarrow.parquet
from pandas.api.types import is_numeric_dtype

from fishd.core import text
from fishd.core.errors import RecordingError
from fishd.core.files import os_errors, write_atomically
from fishd.recording.folder import check_new_files
from fishd.recording.images import RecordedFrame
from fishd.recording.reader import Run

FORMATS = (".csv", ".parquet")


def export(run: Run, path: Path, *, replace: bool = False) -> list[Path]:
    """Write `NAME.csv` and `NAME-events.csv`, or the same as Parquet, and return their paths.

    path: file of the ticks, whose suffix chooses the format
    With frames of a camera, also `NAME-frames.npy`, all frames as one array of shape (number,
    height, width), and `NAME-frames.csv`, one row per frame.

    Ticks have one column per field, in its unit, at full precision. In CSV, which terminals and
    spreadsheets show, control characters are escaped, and a `'` precedes a text that a spreadsheet
    would evaluate. The Parquet files have all texts unchanged, and contain configuration and
    provenance as the metadata `fishd` of their schema, in JSON.

    replace: whether to replace existing files
    Raise `RecordingError`.
    """
    form, folder, name = path.suffix, path.parent, path.stem
    if form not in FORMATS:
        raise RecordingError(f"{path}: a name that ends in {' or '.join(FORMATS)} is needed")
    if not run.entries and not run.frame_heads:
        why = f" ({run.damage_reason})" if run.damage_reason else ""
        raise RecordingError(f"{run.path} contains nothing to export{why}")
    tables = {path: run.frame(), folder / f"{name}-events{form}": _event_table(run)}
    pictures = folder / f"{name}-frames.npy"
    if run.frame_heads:
        tables[folder / f"{name}-frames{form}"] = _frame_table(run)
    check_new_files([*tables, *([pictures] if run.frame_heads else [])], replace=replace)
    about = b""
    if form == ".parquet":
        about = msgspec.json.encode({"about": run.about, "configs": run.configs})
    for path, table in tables.items():
        with os_errors(RecordingError, f"{path} cannot be written"):
            if form == ".csv":
                write_atomically(path, _escape_texts(table).to_csv(index=False))
            else:
                _write_parquet(path, table, about, run)
    if run.frame_heads:
        _write_pictures(pictures, run)
        return [*tables, pictures]
    return list(tables)


def _escape_texts(table: pandas.DataFrame) -> pandas.DataFrame:
    """Return the table with escaped texts, so that no terminal or spreadsheet executes them."""
    escaped = table.copy(deep=False)
    for name in table.columns[[not is_numeric_dtype(kind) for kind in table.dtypes]]:
        escaped[name] = escaped[name].map(
            lambda value: text.for_spreadsheet(value) if isinstance(value, str) else value
        )
    escaped.columns = pandas.Index([text.for_spreadsheet(name) for name in table.columns])
    return escaped


def _event_table(run: Run) -> pandas.DataFrame:
    rows = [
        (
            event.t,
            event.level,
            event.kind,
            event.message,
            msgspec.json.encode(event.data).decode(),
            event.time,
            elapsed,
        )
        for event, elapsed in zip(run.events, run.times_of("event"), strict=True)
    ]
    columns = ["t", "level", "kind", "message", "data", "time", "elapsed"]
    return pandas.DataFrame(rows, columns=columns)


def _frame_table(run: Run) -> pandas.DataFrame:
    return pandas.DataFrame([msgspec.structs.asdict(head) for head in run.frame_heads])


def _write_pictures(path: Path, run: Run) -> None:
    """Write the frames one by one, since hours of them may exceed the memory of this machine."""
    frames = run.frames()
    first = next(frames)
    shape = (len(run.frame_heads), *first.pixels.shape)
    part = path.with_name(path.name + ".part")
    try:
        with os_errors(RecordingError, f"{path} cannot be written"):
            _check_room(path, math.prod(shape))
            array = np.lib.format.open_memmap(part, mode="w+", dtype=np.uint8, shape=shape)
            for number, frame in enumerate(itertools.chain([first], frames)):
                if frame.pixels.shape != first.pixels.shape:
                    raise RecordingError(
                        f"{run.path}: frames of {_format_size(first)} and of "
                        f"{_format_size(frame)}: one array cannot hold both; in Python, "
                        "fishd.recording.open_run(...).frames() gives them"
                    )
                array[number] = frame.pixels
            array.flush()
            part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _check_room(path: Path, size: int) -> None:
    """Raise `RecordingError` if the disk lacks space, since a full disk would kill the process."""
    free = shutil.disk_usage(path.parent).free
    if size > free:
        raise RecordingError(
            f"{path} would take {size / 1e9:.1f} GB: only {free / 1e9:.1f} GB are free"
        )


def _format_size(frame: RecordedFrame) -> str:
    height, width = frame.pixels.shape
    return f"{width} x {height} px"


def _write_parquet(path: Path, frame: pandas.DataFrame, about: bytes, run: Run) -> None:
    try:
        table = pyarrow.Table.from_pandas(frame, preserve_index=False)
    except (pyarrow.ArrowException, OverflowError) as error:
        raise RecordingError(
            f"{run.path} cannot be written as Parquet: {text.error_message(error)}; --csv takes "
            "any number"
        ) from None
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), b"fishd": about})
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(table, sink)
    write_atomically(path, sink.getvalue().to_pybytes())
