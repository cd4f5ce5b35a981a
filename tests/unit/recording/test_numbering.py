"""The order of recordings: running numbers decide, whatever clocks and times of files say."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from rigs.recordings import swum

from fishd.core.errors import RecordingError
from fishd.lab.experiment import Header, list_experiments, open_experiment
from fishd.recording import RunWriter
from fishd.recording.black_box import BlackBox
from fishd.recording.folder import find_recording, list_recordings, open_new
from fishd.recording.numbering import read_number

YEAR_S = 365 * 86400.0


def record(folder: Path, name: str) -> Path:
    """Write a short recording."""
    with RunWriter(folder / name) as writer:
        for tick in swum(0.2).recorder.ticks:
            writer.tick(tick)
    return writer.path


def reverse_times(folder: Path) -> None:
    """Give newer files older modification times, as after a boot with a wrong clock."""
    for age, path in enumerate(sorted(folder.iterdir(), key=read_number)):
        os.utime(path, (1.7e9 - age * YEAR_S,) * 2)


def names(folder: Path) -> list[str]:
    return [path.stem for path in list_recordings(folder)]


def test_the_order_is_that_of_the_recordings_and_not_of_the_times_of_their_files(
    tmp_path: Path,
) -> None:
    for name in ("morning", "evening", "again"):
        record(tmp_path, name)
    reverse_times(tmp_path)
    assert names(tmp_path) == ["morning", "evening", "again"]
    assert find_recording("latest", tmp_path).stem == "again"


def test_a_black_box_removes_its_oldest_files_after_a_boot_with_a_wrong_clock(
    tmp_path: Path,
) -> None:
    ticks = swum(10.0).recorder.ticks
    for _ in range(4):
        writer = BlackBox(tmp_path, 10**9, RunWriter).open()
        for tick in ticks:
            writer.tick(tick)
        writer.close()
    reverse_times(tmp_path)
    size = sum(path.stat().st_size for path in tmp_path.glob("*.mcap"))
    BlackBox(tmp_path, round(size * 0.6), RunWriter).open().close()
    assert [read_number(path) for path in list_recordings(tmp_path)] == [3, 4, 5]


def test_a_folder_from_another_machine_keeps_its_order_and_gets_larger_numbers(
    tmp_path: Path,
) -> None:
    there, here = tmp_path / "there", tmp_path / "here"
    for folder, name in ((there, "a"), (there, "b"), (there, "c"), (here, "mine")):
        folder.mkdir(exist_ok=True)
        record(folder, name)
    for path in there.glob("*.mcap"):
        shutil.copy(path, here)
    record(here, "newest")
    assert read_number(here / "newest.mcap") == 4
    assert names(here) == ["a", "mine", "b", "c", "newest"]


def test_recordings_without_a_number_are_older_in_the_order_of_their_names(
    tmp_path: Path,
) -> None:
    numbered = record(tmp_path, "a")
    for name in ("2026-11-28-101112", "2026-11-28-101112-2", "2025-01-01-000000"):
        content = numbered.read_bytes().replace(b"number\x01\0\0\x001", b"nothin\x01\0\0\x001")
        assert content != numbered.read_bytes()
        (tmp_path / f"{name}.mcap").write_bytes(content)
    (tmp_path / "0.mcap.part").touch()  # left by a power cut
    reverse_times(tmp_path)
    assert names(tmp_path) == [
        "0.mcap", "2025-01-01-000000", "2026-11-28-101112", "2026-11-28-101112-2", "a",
    ]  # fmt: skip


def test_recorders_that_begin_at_one_moment_get_names_of_their_own(
    tmp_path: Path,
) -> None:
    with ThreadPoolExecutor(8) as pool:
        writers = list(pool.map(lambda _: open_new(tmp_path, RunWriter), range(24)))
    for writer in writers:
        writer.close()
    assert len({writer.path for writer in writers}) == len(list_recordings(tmp_path)) == 24


def test_a_folder_that_cannot_be_written_is_refused_once(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be written: No such file or directory"):
        open_new(tmp_path / "nowhere", RunWriter)


def test_experiments_are_listed_in_their_order_whatever_the_times_of_their_files_are(
    tmp_path: Path,
) -> None:
    kinds = ("sweep", "measure", "adapt")
    for kind in kinds:
        with open_experiment(tmp_path / kind, Header(kind=kind, on="live")):
            pass
    for age, kind in enumerate(kinds):
        os.utime(tmp_path / kind / "experiment.json", (1.7e9 - age * YEAR_S,) * 2)
    assert [path.name for path, _ in list_experiments(tmp_path)] == list(kinds)
