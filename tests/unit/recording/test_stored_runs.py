"""Stored runs: notes and names, the trash and its undo, and a run as one zip file."""

import errno
import io
import json
import os
import shutil
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rigs.processes import fishctl, one_line
from rigs.recordings import record_run, swum

from fishd.core.errors import RecordingError
from fishd.core.process.lockfile import locked
from fishd.lab.experiment import Header, open_experiment
from fishd.recording import RunWriter, open_run, stored_runs
from fishd.recording.stored_runs import KEPT_DAYS, TRASH, delete_run, empty_trash, list_trash

HEADER = Header(kind="sweep", on="simulation", command=["square"])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(swum(1.0), tmp_path_factory.mktemp("recorded") / "first", note="as recorded")


@pytest.fixture
def folder(tmp_path: Path, recorded: Path) -> Path:
    """A folder of runs with the recording `first` and the experiment `swept`."""
    shutil.copy(recorded, tmp_path / "first.mcap")
    with open_experiment(tmp_path / "swept", HEADER) as experiment:
        experiment.open_table(["x"]).add({"x": 1.5})
    return tmp_path


def runs(folder: Path, *words: str) -> str:
    """Return what a verb of `fishctl runs` prints."""
    done = fishctl("runs", "--folder", str(folder), *words)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def refuse(folder: Path, *words: str) -> str:
    """Return the line by which a verb of `fishctl runs` is refused; nothing may change."""
    before = sorted(folder.rglob("*"))
    done = fishctl("runs", "--folder", str(folder), *words)
    assert done.returncode == 1
    assert sorted(folder.rglob("*")) == before
    return one_line(done)


def listed(folder: Path) -> dict[str, str]:
    """Return the notes of all runs by name."""
    entries = json.loads(fishctl("runs", "--json", "--folder", str(folder)).stdout)
    return {entry["name"]: entry["about"].get("note", "") for entry in entries}


@pytest.mark.parametrize("run", ["first", "first.mcap", "swept"])
def test_a_note_is_changed_and_everything_shows_the_new_one(folder: Path, run: str) -> None:
    content = (folder / "first.mcap").read_bytes()
    runs(folder, "note", run, "Flosse 3, größer")
    name = run.removesuffix(".mcap")
    assert listed(folder)[name] == "Flosse 3, größer"
    assert "Flosse 3, größer" in runs(folder)
    runs(folder, "note", run, "")
    assert listed(folder)[name] == ""
    assert (folder / "first.mcap").read_bytes() == content
    assert open_run(folder / "first.mcap").about["note"] == (
        "" if name == "first" else "as recorded"
    )


@pytest.mark.parametrize("run", ["first", "swept"])
def test_a_run_is_renamed_deleted_and_restored_with_its_note(folder: Path, run: str) -> None:
    runs(folder, "note", run, "mine")
    runs(folder, "rename", run, "better name")
    assert listed(folder)["better name"] == "mine"
    said = runs(folder, "delete", "better name")
    assert "better name" not in listed(folder)
    (deleted,) = json.loads(runs(folder, "trash", "--json"))
    assert said.rstrip().endswith(f"to undo: fishctl runs restore {deleted['id']}")
    assert abs(deleted["deleted"] - time.time()) < 600.0
    runs(folder, "restore", deleted["id"])
    assert listed(folder)["better name"] == "mine"
    assert runs(folder, "trash") == ""
    assert len(listed(folder)) == 2


def test_of_several_deleted_runs_of_one_name_the_latest_comes_back_first(folder: Path) -> None:
    for note in ("older", "newer"):
        runs(folder, "note", "first", note)
        content = (folder / "first.mcap").read_bytes()
        runs(folder, "delete", "first")
        (folder / "first.mcap").write_bytes(content)
    assert "exists already; rename that one first" in refuse(folder, "restore", "first")
    runs(folder, "rename", "first", "third")
    runs(folder, "restore", "first")
    assert listed(folder)["first"] == "newer"
    runs(folder, "delete", "first", "third")
    assert len(list_trash(folder)) == 3
    assert fishctl("runs", "trash", "--empty", "--folder", str(folder)).stdout == "3 runs removed\n"
    assert list_trash(folder) == []


def test_a_run_stays_in_the_trash_for_30_days(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deleted = delete_run(folder / "first.mcap")
    for days, kept in ((KEPT_DAYS - 0.1, 1), (-KEPT_DAYS, 1), (KEPT_DAYS + 0.1, 0)):
        later = deleted.deleted + days * 86400
        monkeypatch.setattr(stored_runs.time, "time", lambda later=later: later)
        empty_trash(folder, KEPT_DAYS)
        assert len(list_trash(folder)) == kept


@pytest.mark.parametrize("verb", [("rename", "other"), ("delete",)])
def test_a_run_in_progress_is_neither_renamed_nor_deleted(
    folder: Path, verb: tuple[str, ...]
) -> None:
    name, *more = verb
    in_progress = "is in progress; stop it, or wait for its end"
    for lock in ("experiment", "training"):
        with locked(folder / "swept" / lock, remove=True):
            assert in_progress in refuse(folder, name, "swept", *more)
    with RunWriter(folder / "now") as writer:
        writer.tick(swum(0.1).recorder.ticks[0])
        writer.flush()
        assert in_progress in refuse(folder, name, "now", *more)
    (folder / "now.mcap").rename(folder / "now.mcap.part")  # as a kill leaves it
    assert not runs(folder, name, "now", *more).startswith("fishctl")


NAMES = [
    "first",
    "first.mcap",
    "swept",
    "",
    ".",
    "..",
    ".x",
    "-x",
    "a/b",
    "a\nb",
    "a" * 101,
    "x.part",
    "a\x1b",
    "latest",
    "x ",
    "queue.json",
    "noted",
]


@pytest.mark.parametrize("name", NAMES)
def test_no_run_gets_a_name_that_is_taken_or_leads_elsewhere(folder: Path, name: str) -> None:
    (folder / "noted.note.txt").write_text("of a recording that was removed by hand")
    for run in ("first", "swept"):
        line = refuse(folder, "rename", run, "--", name)
        assert "exists already" in line or "cannot be a name: letters, digits" in line


@pytest.mark.parametrize(
    "run", ["../first", "/etc", ".trash", "first\n", "none", "linked", "plain"]
)
def test_only_runs_of_the_folder_are_changed(folder: Path, run: str) -> None:
    (folder / "linked.mcap").symlink_to(folder / "first.mcap")
    (folder / "plain").mkdir()
    for verb, *more in (("delete",), ("note", "x"), ("rename", "y"), ("zip", "--to", "-")):
        line = refuse(folder, verb, run, *more)
        assert "is not the name of a run" in line or "no run is named" in line or "link" in line


@pytest.mark.parametrize("header", [b"", b"{", b"\xff", b'{"kind": 1}'])
def test_an_experiment_of_another_tool_is_noted_renamed_packed_and_deleted(
    folder: Path, header: bytes
) -> None:
    (folder / "swept" / "experiment.json").write_bytes(header)
    runs(folder, "note", "swept", "of another tool")
    runs(folder, "rename", "swept", "foreign")
    assert listed(folder)["foreign"] == "of another tool"
    runs(folder, "delete", "foreign")
    runs(folder, "restore", "foreign")
    assert (folder / "foreign" / "experiment.json").read_bytes() == header


def no_space(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "x")


@pytest.mark.parametrize(
    ("part", "words", "said"),
    [
        ("mkdir", ("delete", "first"), "'fishctl runs trash --empty' makes room"),
        ("rename", ("delete", "swept"), "swept cannot be moved"),
        ("rename", ("rename", "swept", "x"), "swept cannot be moved"),
        ("note", ("note", "first", "x"), "first.note.txt cannot be written"),
    ],
)
def test_a_full_disk_is_one_line_and_changes_nothing(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    part: str,
    words: tuple[str, ...],
    said: str,
) -> None:
    (folder / TRASH).mkdir()
    if part == "note":
        monkeypatch.setattr(stored_runs.files, "write_atomically", no_space)
    else:
        monkeypatch.setattr(Path, part, no_space)
    line = refuse(folder, *words)
    assert said in line
    assert line.endswith("No space left on device\n")


def test_a_zip_file_for_which_the_disk_is_too_full_leaves_no_part(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_runs.shutil, "copyfileobj", no_space)
    line = refuse(folder, "zip", "swept", "--to", str(folder / "x.zip"))
    assert "x.zip cannot be written: No space" in line


def test_a_file_whose_name_is_not_text_is_packed_under_a_similar_one(folder: Path) -> None:
    (folder / "swept" / os.fsdecode(b"fish\xff")).write_bytes(b"x")
    stream = io.BytesIO()
    stored_runs.pack_run(folder / "swept", stream)
    with zipfile.ZipFile(stream) as archive:
        assert archive.read("swept/fish?") == b"x"


def test_two_programs_delete_and_empty_at_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    delete_run(folder / "first.mcap")
    (place,) = (folder / TRASH).iterdir()
    taken, find_unused = [place], stored_runs.files.unused_path
    monkeypatch.setattr(
        stored_runs.files,
        "unused_path",
        lambda *names: taken.pop() if taken else find_unused(*names),
    )
    assert delete_run(folder / "swept").id != place.name
    gone = folder / TRASH / "20260101-000000"
    monkeypatch.setattr(stored_runs, "_list_places", lambda *_, **__: [gone, place])
    assert [run.name for run in list_trash(folder)] == ["first"]
    empty_trash(folder)
    assert list_trash(folder) == []


def test_a_run_that_cannot_be_removed_keeps_no_other_and_is_no_part_of_a_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for run in ("first.mcap", "swept"):
        delete_run(folder / run)
    remove, (kept, _) = shutil.rmtree, sorted((folder / TRASH).iterdir())

    def fail(path: Path) -> None:
        if path.name.endswith(kept.name):
            raise PermissionError(errno.EPERM, "not permitted")
        remove(path)

    monkeypatch.setattr(shutil, "rmtree", fail)
    done = fishctl("runs", "--folder", str(folder), "trash", "--empty")
    assert "cannot be removed: not permitted" in one_line(done)
    assert list_trash(folder) == []
    assert len([*(folder / TRASH).iterdir()]) == 1
    monkeypatch.undo()
    assert empty_trash(folder) == 1
    assert [*(folder / TRASH).iterdir()] == []


def test_a_trash_that_is_a_link_takes_nothing(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (folder / TRASH).symlink_to(outside)
    assert "it is a symbolic link" in refuse(folder, "delete", "first")
    (outside / "20000101-000000").mkdir()
    assert empty_trash(folder) == 0
    assert (outside / "20000101-000000").is_dir()


def test_a_run_that_is_removed_while_it_is_packed_is_no_zip_file(folder: Path) -> None:
    class Stream(io.BytesIO):
        def write(self, data: Any) -> int:
            if (folder / "swept").exists():
                delete_run(folder / "swept")
                empty_trash(folder)
            return super().write(data)

    with pytest.raises(RecordingError, match="swept was removed before all of it was packed"):
        stored_runs.pack_run(folder / "swept", Stream())


def make_fifo(path: Path) -> None:
    os.mkfifo(path)


@pytest.mark.parametrize("make", [make_fifo, lambda path: path.symlink_to("/etc/hostname")])
def test_a_zip_file_has_all_files_of_a_run_and_nothing_else(
    folder: Path, make: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    runs(folder, "note", "first", "x")
    swept = folder / "swept"
    (swept / "ticks").mkdir()
    (swept / "ticks" / "1.mcap").write_bytes(b"x" * 100_000)
    os.utime(swept / "rows.csv", (0, 0))  # a clock that is wrong
    make(swept / "more")
    (swept / "outside").symlink_to(folder.parent)
    assert runs(folder, "zip", "swept") == "swept.zip\n"
    assert "File exists; give another file with --to" in refuse(folder, "zip", "swept")
    with zipfile.ZipFile("swept.zip") as archive:
        names = {"experiment.json", "rows.csv", "ticks/1.mcap"}
        assert set(archive.namelist()) == {f"swept/{name}" for name in names}
        assert archive.read("swept/rows.csv") == (swept / "rows.csv").read_bytes()
        assert archive.testzip() is None
    assert "write it outside" in refuse(folder, "zip", "swept", "--to", "swept/x.zip")
    stream = io.BytesIO()
    stored_runs.pack_run(folder / "first.mcap", stream)
    with zipfile.ZipFile(stream) as archive:
        assert archive.namelist() == ["first/first.mcap", "first/first.note.txt"]
