"""Writes a recording as tables for other programs: CSV or Parquet, ticks and events."""

from pathlib import Path
from typing import Literal

import msgspec
import pandas
import pyarrow
import pyarrow.parquet

from fishd.core.errors import RecordingError
from fishd.core.files import write_atomically
from fishd.recording.folder import check_new
from fishd.recording.reader import Run

Format = Literal["csv", "parquet"]


def export(run: Run, folder: Path, form: Format, *, replace: bool = False) -> list[Path]:
    """Write `NAME.csv` and `NAME-events.csv`, or the same as Parquet; their paths.

    Ticks have a column a field, in its unit, and every bit of its value. The Parquet files carry
    configuration and provenance as the metadata `fishd` of their schema, in JSON.

    replace: may there be files of these names?
    Raises `RecordingError`.
    """
    tables = {folder / f"{run.name}.{form}": run.frame()}
    tables[folder / f"{run.name}-events.{form}"] = _events(run)
    check_new(tables, replace=replace)
    about = msgspec.json.encode({"about": run.about, "configs": run.configs})
    for path, table in tables.items():
        try:
            if form == "csv":
                write_atomically(path, table.to_csv(index=False))
            else:
                _write_parquet(path, table, about)
        except OSError as error:
            raise RecordingError(f"{path} cannot be written: {error.strerror or error}") from None
    return list(tables)


def _events(run: Run) -> pandas.DataFrame:
    rows = [
        (event.t, event.level, event.kind, event.message, msgspec.json.encode(event.data).decode())
        for event in run.events
    ]
    return pandas.DataFrame(rows, columns=["t", "level", "kind", "message", "data"])


def _write_parquet(path: Path, frame: pandas.DataFrame, about: bytes) -> None:
    table = pyarrow.Table.from_pandas(frame, preserve_index=False)
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), b"fishd": about})
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(table, sink)
    write_atomically(path, sink.getvalue().to_pybytes())
