"""The file of a queue: what it keeps, what it refuses, and what it says of a killed runner."""

import time
from pathlib import Path

import pytest

from fishd.core import experiment_queue
from fishd.core.addresses import find_control_address
from fishd.core.experiment_queue import MAX_ITEMS, QueueError, QueueFile

WORDS = ["measure", "swing"]
ADDRESS = "ipc:///tmp/fish/control"


@pytest.fixture
def file(tmp_path: Path) -> QueueFile:
    """Return the file of a queue in a folder that does not exist yet."""
    return QueueFile(tmp_path / "runs", ADDRESS)


def add(file: QueueFile, *seconds: float | None, repeat: int = 1) -> None:
    with file.changing() as queue:
        for each in seconds:
            queue.add(WORDS, repeat, each)


def order(file: QueueFile) -> list[int]:
    return [item.id for item in QueueFile(file.runs, ADDRESS).read().items]


def test_what_is_added_moved_and_removed_is_what_another_process_reads(file: QueueFile) -> None:
    add(file, 60.0, 60.0, 60.0)
    with file.changing() as queue:
        queue.move(3, 1)
    assert order(file) == [3, 1, 2]
    with file.changing() as queue:
        queue.move(3, MAX_ITEMS)
        queue.remove(1)
    assert order(file) == [2, 3]
    with file.changing() as queue:
        queue.clear()
        assert queue.add(WORDS, 1, None).id == 4  # a number never means another experiment later


def test_an_unknown_number_and_one_experiment_too_many_are_refused(file: QueueFile) -> None:
    with pytest.raises(QueueError, match="no experiment 7; in the queue: it is empty"):
        file.read().find(7)
    add(file, *[None] * MAX_ITEMS)
    with pytest.raises(QueueError, match=f"it has {MAX_ITEMS} experiments"):
        add(file, None)
    assert len(file.read().items) == MAX_ITEMS


def test_each_fish_has_its_queue_and_that_of_this_machine_does_not_depend_on_its_address(
    tmp_path: Path,
) -> None:
    addresses = ("ipc:///a/b-c", "ipc:///a-b/c", "ipc:///" + 90 * "ü", "tcp://192.0.2.1:9")
    names = {QueueFile(tmp_path, address).path.name for address in addresses}
    assert len(names) == len(addresses)
    assert all(name.isascii() and len(name) < 110 for name in names)
    for address in (None, "ipc:///run/fishd/control", find_control_address()):
        assert QueueFile(tmp_path, address).path.name == "queue.json"


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "is damaged"),
        (b'{"version": 1, "items": [{"id": 1', "is damaged"),
        (b'{"version": 1, "items": [{"id": 1, "words": 7}]}', "is damaged: Expected `array`"),
        (b'{"version": 1, "items": [{"id": 1, "words": [], "cwd": "/", "repeat": 0}]}', "damaged"),
        (b'{"version": 1, "items": [{"id": 1, "words": [], "cwd": "/"}]}', r"length >= 1 .*words"),
        (b'{"version": 1, "items": [{"id": 1, "words": ["a"], "cwd": "", "run": "../.."}]}', "run"),
        (b'{"version": 1, "pause_at": 1e300}', "pause_at"),
        (b'{"version": 1, "colour": "a change would lose it"}', "unknown field `colour`"),
        (b"[" * 100_000, "is damaged"),
        (b"\xff", "is damaged"),
        (b'{"version": 2, "items": "of another kind"}', "was written by a later fishd"),
        (b" " * (2**20 + 1), "is longer than 1 MB"),
    ],
)
def test_a_file_that_is_not_understood_is_one_line_and_stays_as_it_is(
    file: QueueFile, content: bytes, complaint: str
) -> None:
    file.runs.mkdir()
    file.path.write_bytes(content)
    for use in (file.read, file.view, lambda: add(file, 1.0)):
        with pytest.raises(QueueError, match=complaint) as refusal:
            use()
        assert str(file.path) in str(refusal.value)
        assert "\n" not in str(refusal.value)
    assert file.path.read_bytes() == content


def test_a_link_to_another_file_is_neither_read_nor_replaced(
    file: QueueFile, tmp_path: Path
) -> None:
    add(file, 60.0)
    file.path.rename(tmp_path / "elsewhere.json")
    file.path.symlink_to(tmp_path / "elsewhere.json")
    for use in (file.view, lambda: add(file, 1.0)):
        with pytest.raises(QueueError, match="is a symbolic link; a regular file is needed"):
            use()
    assert file.path.is_symlink()


def test_a_disk_that_is_full_leaves_the_queue_as_it_was(
    file: QueueFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    add(file, 60.0)

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(experiment_queue, "write_atomically", refuse)
    with pytest.raises(QueueError, match=r"cannot be written: No space .*; the queue is unchanged"):
        add(file, 60.0)
    assert order(file) == [1]


def test_a_folder_that_cannot_be_created_is_one_line(file: QueueFile) -> None:
    file.runs.write_text("a file")
    with pytest.raises(QueueError, match="cannot be written: File exists"):
        add(file, 60.0)
    with pytest.raises(QueueError, match="lock cannot be written: File exists"), file.running():
        pass


def test_what_ran_when_its_runner_was_killed_is_said_and_nothing_runs_any_more(
    file: QueueFile,
) -> None:
    add(file, 60.0)
    with file.running(), file.changing() as queue:
        queue.current, queue.began = 1, 1e9
    view = file.view()
    assert (view.state, view.current, view.elapsed) == ("paused", None, 0.0)
    assert "went down while experiment 1 ran, which began at 2001-09-" in view.reason
    add(file, 60.0)  # a change keeps the reason
    assert file.read().reason == view.reason
    assert file.read().current is None


def test_there_is_one_runner_at_a_time(file: QueueFile, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiment_queue, "RUNNER_TIMEOUT_S", 0.0)
    with file.running():
        complaint = r"process \d+ runs this queue already"
        with pytest.raises(QueueError, match=complaint), file.running():
            pass
        assert file.view().state == "running"
    assert file.find_runner() is None


def test_the_experiment_that_runs_is_neither_removed_nor_cleared(file: QueueFile) -> None:
    add(file, 60.0, 60.0)
    with file.running():
        with file.changing() as queue:
            queue.current = 1
        with pytest.raises(QueueError, match="stop it first, with 'fishctl queue pause --now'"):
            file.read().remove(1)
        with file.changing() as queue:
            queue.clear()
        assert order(file) == [1]


def test_the_time_that_is_left_counts_all_runs_and_what_has_passed(
    file: QueueFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "time", lambda: 1010.0)
    add(file, 60.0, 20.0, repeat=3)
    add(file, None)
    view = file.view()
    assert (view.left, view.unknown, view.state) == (240.0, 1, "paused")
    with file.running():
        with file.changing() as queue:
            queue.current, queue.began = 1, 1000.0
        assert (file.view().left, file.view().elapsed) == (230.0, 10.0)
        with file.changing() as queue:
            queue.began = 0.0  # longer than expected: the other runs are left
        assert file.view().left == 180.0
