"""The Python example of docs/how-to/recording.md that reads an exported table, run unchanged."""

import sys
from pathlib import Path

import pytest
from rigs.documents import FENCE, ROOT, text_of
from rigs.processes import call, fishctl
from rigs.recordings import record_run, swum

PAGE = ROOT / "docs" / "how-to" / "recording.md"
BLOCKS = [
    block
    for kind, block in FENCE.findall(text_of(PAGE))
    if kind == "python" and "first.parquet" in block
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the export of a short swim."""
    folder = tmp_path_factory.mktemp("export")
    run = record_run(swum(), folder / "first")
    done = fishctl("export", str(run), "--parquet", "--to", str(folder))
    assert done.stdout.split() == [str(folder / f"first{part}.parquet") for part in ("", "-events")]
    return folder


def test_the_example_reads_the_table_and_prints_numbers(folder: Path) -> None:
    (block,) = BLOCKS
    done = call(sys.executable, "-W", "error", "-c", block, cwd=folder)
    assert (done.returncode, done.stderr) == (0, "")
    for words in ("Name: fx", "swing takes over"):
        assert words in done.stdout
