"""Tables of recordings, which fishctl writes: for downloads, and for the curves of a simulation."""

import asyncio
import csv
import shutil
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from fishd.window.children import call

_COLUMNS = ("time", "fx", "fy", "phi_c", "alpha", "thrust")
"""Columns of a recording that a page draws."""


@asynccontextmanager
async def exported(recording: Path, form: str, scratch: Path, runs: Path) -> AsyncIterator[Path]:
    """Provide a folder with the tables of a recording while this lasts; raise `JobError`.

    form: `csv` or `parquet`; scratch: place of that folder
    """
    place = Path(await asyncio.to_thread(tempfile.mkdtemp, dir=scratch))
    try:
        await call(["export", str(recording), f"--{form}", f"--to={place}", "--json"], runs)
        yield place
    finally:
        await asyncio.to_thread(shutil.rmtree, place, ignore_errors=True)


async def read_curve(recording: Path, runs: Path) -> dict[str, list[float | None]]:
    """Return columns of a recording, and remove it; raise `JobError`."""
    try:
        async with exported(recording, "csv", recording.parent, runs) as place:
            return await asyncio.to_thread(_read_columns, place / f"{recording.stem}.csv")
    finally:
        await asyncio.to_thread(recording.unlink, missing_ok=True)


def _read_columns(path: Path) -> dict[str, list[float | None]]:
    columns: dict[str, list[float | None]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            for name in _COLUMNS:
                if name in row:
                    value = row[name]
                    columns.setdefault(name, []).append(float(value) if value else None)
    return columns
