"""Curves of a simulated fish, which a page draws beside those of the true one."""

import asyncio
import csv
import shutil
from pathlib import Path

from fishd.window.children import call

_COLUMNS = ("time", "fx", "fy", "phi_c", "alpha", "thrust")
"""Columns of a recording that a page draws."""


async def read_curve(recording: Path, runs: Path) -> dict[str, list[float | None]]:
    """Return columns of a recording, and remove it; raise `JobError`."""
    folder = recording.with_suffix("")
    await asyncio.to_thread(folder.mkdir)
    try:
        words = ["export", str(recording), "--csv", f"--to={folder}", "--force"]
        await call(words, runs)
        return await asyncio.to_thread(_read_columns, folder)
    finally:
        await asyncio.to_thread(_remove, recording, folder)


def _remove(recording: Path, folder: Path) -> None:
    recording.unlink(missing_ok=True)
    shutil.rmtree(folder)


def _read_columns(folder: Path) -> dict[str, list[float | None]]:
    columns: dict[str, list[float | None]] = {}
    path = next(folder.glob("*[!s].csv"))
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            for name in _COLUMNS:
                if name in row:
                    value = row[name]
                    columns.setdefault(name, []).append(float(value) if value else None)
    return columns
