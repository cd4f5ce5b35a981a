"""Whatever a name leads to, a pipe, a device, a file without an end, the answer comes at once."""

import errno
import os
import socket
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click
import pytest
from rigs.processes import PATIENCE

from fishd.cli.calibrate import load_files
from fishd.config import load
from fishd.controllers.policy import file as policy_file
from fishd.core import files
from fishd.core.calibration import ForceCalibration
from fishd.core.errors import ConfigError, FishdError, PolicyError
from fishd.hardware.calibration_files import CalibrationFolder

FORCE = "force-2026-01-01T000000.000000Z.yaml"


def pipe(path: Path) -> None:
    os.mkfifo(path)


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.mkdir()


def listened_at(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        before = Path.cwd()
        os.chdir(path.parent)  # whose path may be too long for a socket
        listener.bind(path.name)
        os.chdir(before)


def hole(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**40)


PLANTS = {
    pipe: "is a named pipe; a regular file is needed",
    endless: "is a device; a regular file is needed",
    folder: "is a folder; a regular file is needed",
    listened_at: "is a socket; a regular file is needed",
    hole: "is longer than ",
}

READERS: dict[str, Callable[[Path], object]] = {
    "fish.yaml": load,
    FORCE: lambda path: CalibrationFolder(path.parent).newest(ForceCalibration),
    "loads.csv": lambda path: load_files.read(path, "N"),
    "swim.onnx": policy_file.read,
}


def complaint(read: Callable[[Path], object], path: Path) -> str:
    """Return the complaint of a reader, which must come in time."""
    complaints: list[str] = []

    def run() -> None:
        try:
            read(path)
        except (ConfigError, PolicyError, FishdError, click.ClickException) as error:
            complaints.append(str(error))

    reader = threading.Thread(target=run, daemon=True)
    reader.start()
    reader.join(PATIENCE)
    assert complaints, "it does not end, or accepts it"
    assert "\n" not in complaints[0]
    return complaints[0]


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.__name__)
@pytest.mark.parametrize("name", READERS)
def test_what_is_no_file_is_told(tmp_path: Path, name: str, plant: Callable[[Path], None]) -> None:
    plant(tmp_path / name)
    told = f"{tmp_path / name}: {PLANTS[plant]}"
    assert complaint(READERS[name], tmp_path / name).startswith(told)


def test_a_file_that_the_kernel_makes_up_is_read_no_further_than_is_permitted() -> None:
    path = Path("/proc/self/status")
    assert files.read(path, 10**6, "a test").startswith(b"Name:")
    with pytest.raises(files.FileProblem, match="is longer than 0 kB, far more than a test needs"):
        files.read(path, 10, "a test")


def test_a_file_of_just_the_greatest_length_is_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x" * 1024)
    assert len(files.read(tmp_path / "file", 1024, "a test")) == 1024
    with pytest.raises(files.FileProblem):
        files.read(tmp_path / "file", 1023, "a test")


@pytest.mark.parametrize("path", ["none", "none/none", "a\0b"])
def test_what_is_not_there_is_told_from_what_cannot_be_read(tmp_path: Path, path: str) -> None:
    with pytest.raises(files.NoFile, match="no such file"):
        files.read(tmp_path / path, 10, "a test")


def test_a_link_to_a_good_file_is_followed_and_lines_end_alike(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes("\ufeffone\r\ntwo\rthrée\n".encode())
    (tmp_path / "link").symlink_to(tmp_path / "file")
    text = files.read_text(tmp_path / "link", 100, "a test", "utf-8-sig")
    assert text == "one\ntwo\nthrée\n"
    (tmp_path / "file").write_bytes(b"\xff")
    with pytest.raises(files.FileProblem, match="not a text file in UTF-8"):
        files.read_text(tmp_path / "link", 100, "a test")


def test_writers_at_the_same_time_leave_a_whole_file_of_one_of_them(tmp_path: Path) -> None:
    path = tmp_path / "file"
    contents = [letter * 100_000 for letter in "abcd"]

    def write(content: str) -> None:
        for _ in range(20):
            files.write_atomically(path, content)
            assert path.read_text() in contents

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, contents))
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_a_file_that_cannot_be_written_is_named_and_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "file"
    path.write_text("before")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as caught:
        files.write_atomically(path, "after")
    assert caught.value.filename == str(path)
    assert [file.name for file in tmp_path.iterdir()] == ["file"]
    assert path.read_text() == "before"


def test_a_new_file_replaces_none_and_has_the_usual_permissions(tmp_path: Path) -> None:
    path, usual = tmp_path / "file", tmp_path / "usual"
    usual.touch()
    files.write_atomically(path, "first", new=True)
    assert path.stat().st_mode == usual.stat().st_mode
    with pytest.raises(FileExistsError):
        files.write_atomically(path, "second", new=True)
    assert path.read_text() == "first"


@pytest.mark.parametrize("path", ["~nobody-here/file", "~nobody\0here", "file/~root", ""])
def test_a_home_that_nobody_has_leaves_a_path_as_it_is(path: str) -> None:
    assert files.expand_user(path) == Path(path)
    assert files.expand_user("~root/file").is_absolute()


def test_a_name_may_be_as_long_as_the_file_system_permits(tmp_path: Path) -> None:
    files.check_writable(tmp_path / ("x" * 255))
    files.write_atomically(tmp_path / ("ö" * 127), "long")
    assert (tmp_path / ("ö" * 127)).read_text() == "long"


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("x" * 256, "cannot be written: File name too long"),
        ("none/file", "its folder does not exist; create it"),
        ("file/file", "cannot be written: Not a directory"),
        ("link", "is a device; a regular file is needed"),
        ("a\0b", "cannot be written: a name has no zero byte"),
    ],
)
def test_an_unwritable_file_is_refused(tmp_path: Path, name: str, complaint: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("/dev/null")
    with pytest.raises(files.FileProblem, match=complaint):
        files.check_writable(tmp_path / name)
    assert {file.name for file in tmp_path.iterdir()} == {"file", "link"}


def test_a_new_name_is_unused_with_every_suffix(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").touch()
    (tmp_path / "run-2.mcap.part").symlink_to("nowhere")
    for suffixes, name in (((".mcap", ".mcap.part"), "run-3.mcap"), (("",), "run")):
        assert files.unused_path(tmp_path, "run", *suffixes) == tmp_path / name
