"""The black box keeps to its size, and to its own files."""

from pathlib import Path

import pytest
from rigs.recordings import record_run, swum

from fishd.recording import RunWriter, open_run
from fishd.recording.black_box import BlackBox
from fishd.recording.folder import list_recordings

KEEP = 600_000


def fill(box: BlackBox, folder: Path, files: int) -> None:
    """Record until this number of files was begun."""
    ticks = swum(10.0).recorder.ticks
    for _ in range(files):
        writer = box.open()
        while not box.due(writer):
            for tick in ticks[:100]:
                writer.tick(tick)
            writer.flush()
            sizes = (path.stat().st_size for path in folder.glob("blackbox-*"))
            assert sum(sizes) <= KEEP
        writer.close("continued in the next file")


def test_the_oldest_files_make_room_and_nobody_elses(tmp_path: Path) -> None:
    mine = record_run(swum(), tmp_path / "mine")
    box = BlackBox(tmp_path, KEEP, RunWriter)
    fill(box, tmp_path, 6)
    oldest = next(path for path in list_recordings(tmp_path) if path != mine).stat().st_mtime_ns
    fill(box, tmp_path, 6)
    assert mine.exists()
    kept = list(tmp_path.glob("blackbox-*"))
    assert all(path.stat().st_mtime_ns > oldest for path in kept)  # names are used again
    assert 5 <= len(kept) <= 8
    assert all(open_run(path).finished for path in kept)


def test_a_file_that_a_power_cut_left_is_finished_at_the_next_start(tmp_path: Path) -> None:
    box = BlackBox(tmp_path, KEEP, RunWriter)
    writer = box.open()
    ticks = swum().recorder.ticks
    for tick in ticks:
        writer.tick(tick)
    writer.flush()
    writer._give_up()  # as a kill does
    (tmp_path / "blackbox-0.mcap.part").touch()  # nothing was written yet
    copies = [Path(f"{path}.recovering") for path in (writer.path, tmp_path / "blackbox-1.mcap")]
    for copy in copies:  # a second power cut, during the recovery from the first
        copy.write_bytes(writer.part.read_bytes())
    with BlackBox(tmp_path, KEEP, RunWriter).open() as now:
        assert open_run(writer.path).ticks == ticks
        assert now.path != writer.path
    assert not any(copy.exists() for copy in copies)


def test_a_full_disk_costs_the_oldest_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = BlackBox(tmp_path, KEEP, RunWriter)
    fill(box, tmp_path, 3)
    oldest, *others = list_recordings(tmp_path)
    writer = box.open()
    monkeypatch.setattr(RunWriter, "free", lambda self: 2 * 16 * 2**20 - 1)
    box.due(writer)
    assert not oldest.exists()
    assert all(path.exists() for path in others)
    writer.close()
