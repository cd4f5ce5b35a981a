"""File of a learned tail."""

from pathlib import Path

import pytest
from rigs.measured_tail import CASES, learn

from fishd.camera.tail.learned import CannotUse, Learned

pytestmark = pytest.mark.slow


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "tail.bin"
    learn(CASES["plain"]).save(path)
    return path


def test_what_was_saved_is_loaded(file: Path) -> None:
    assert Learned.load(file) == learn(CASES["plain"])


@pytest.mark.parametrize("part", [0.3, 0.999, 1.001])
def test_a_torn_file_is_refused(file: Path, part: float) -> None:
    content = file.read_bytes()
    file.write_bytes((content + content)[: round(part * len(content))])
    with pytest.raises(CannotUse, match=r"tail.bin is damaged: learn again"):
        Learned.load(file)


def test_a_foreign_file_is_refused(file: Path) -> None:
    file.write_bytes(b"\x89PNG\r\n")
    with pytest.raises(CannotUse, match=r"tail.bin contains no learned tail"):
        Learned.load(file)


def test_a_file_of_another_version_is_refused(file: Path) -> None:
    file.write_bytes(file.read_bytes().replace(b"tail 2\n", b"tail 3\n", 1))
    with pytest.raises(
        CannotUse, match=r"another version of fishd \(format 3, here 2\): learn again"
    ):
        Learned.load(file)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CannotUse, match=r"tail\.bin"):
        Learned.load(tmp_path / "tail.bin")


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(CannotUse, match=r"tail.bin cannot be written: No such file"):
        learn(CASES["plain"]).save(tmp_path / "missing" / "tail.bin")
