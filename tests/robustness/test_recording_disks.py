"""A disk that becomes full, read-only or stalls while a fish is recorded: no silent loss."""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.processes import FISHCTL, Daemon, Process, running, wait_until
from rigs.small_disk import Disk, NoDisk, small_disk

from fishd.core.errors import RecordingError
from fishd.recording import open_run


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    try:
        with small_disk(tmp_path) as made:
            yield made
    except NoDisk as reason:
        pytest.skip(str(reason))


def last_tick(folder: Path) -> int:
    """Return the number of the last tick in the newest unfinished recording; 0 without one."""
    try:
        return open_run(max(folder.glob("*.part"))).ticks[-1].seq
    except (ValueError, IndexError, RecordingError):
        return 0


def record(daemon: Daemon, disk: Disk, *words: str) -> Process:
    """Start a recorder on a disk."""
    command = (FISHCTL, "--endpoint", daemon.endpoint, "record", *words)
    return Process(*command, "--folder", str(disk.folder), "--json")


def test_a_disk_that_becomes_read_only_ends_a_recording_which_says_what_is_stored(
    tmp_path: Path, disk: Disk
) -> None:
    with running(tmp_path) as daemon, record(daemon, disk, "run") as recording:
        wait_until(lambda: last_tick(disk.folder) > 0)
        disk.make_read_only()
        status, out, lines = recording.finish()
    said = json.loads(out)
    stored = open_run(disk.folder / "run.mcap.part").ticks
    assert status == 1
    assert said["ticks"] == len(stored)
    (lost,) = re.findall(r"its last (\d+) ticks are lost", lines)
    assert said["lost_ticks"] == int(lost) > 0
    assert not said["complete"]
    assert "make the disk writable, then run fishctl recover" in lines


def test_a_full_disk_ends_a_recording_that_is_not_called_complete(
    tmp_path: Path, disk: Disk
) -> None:
    with running(tmp_path) as daemon, record(daemon, disk, "run") as recording:
        wait_until(lambda: last_tick(disk.folder) > 0)
        disk.fill()
        status, out, _ = recording.finish()
    assert (status, json.loads(out)["complete"]) == (1, False)


def test_a_disk_that_stalls_loses_no_tick_and_the_stall_is_said(tmp_path: Path, disk: Disk) -> None:
    with running(tmp_path) as daemon, record(daemon, disk, "run") as recording:
        wait_until(lambda: last_tick(disk.folder) > 0)
        with disk.stalled():
            seq = daemon.status().seq + 60
            wait_until(lambda: daemon.status().seq > seq)
        wait_until(lambda: last_tick(disk.folder) > seq)
        status, out, lines = recording.end()
    said = json.loads(out)
    assert (status, said["lost_ticks"], said["complete"]) == (0, 0, True)
    ticks = [tick.seq for tick in open_run(disk.folder / "run.mcap").ticks]
    assert ticks == list(range(ticks[0], ticks[-1] + 1))
    assert "a write to the disk took" in lines


def test_a_black_box_goes_on_when_the_disk_has_room_again_and_counts_what_it_lost(
    tmp_path: Path, disk: Disk
) -> None:
    with running(tmp_path) as daemon, record(daemon, disk, "--black-box", "--keep", "10MB") as box:
        wait_until(lambda: last_tick(disk.folder) > 0)
        disk.fill()
        wait_until(lambda: bool(list(disk.folder.glob("blackbox-*.mcap"))))  # it has ended
        before = open_run(min(disk.folder.glob("blackbox-*.mcap"))).ticks[-1].seq
        disk.empty()
        wait_until(lambda: last_tick(disk.folder) > before)
        status, _, lines = box.end()
    first = open_run(max(disk.folder.glob("blackbox-*.mcap"))).ticks[0].seq
    assert status == 0
    assert "the black box tries again" in lines
    assert f"just before tick {first}, ticks were lost: {first - before - 1}\n" in lines


def test_a_black_box_goes_on_when_the_folder_of_its_full_disk_is_gone(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = disk.folder / "box"
    monkeypatch.setenv("FISHD_RUNS", str(place))
    with running(tmp_path) as daemon:
        command = (FISHCTL, "--endpoint", daemon.endpoint, "record", "--black-box")
        with Process(*command, "--keep", "10MB", "--json") as box:
            wait_until(lambda: last_tick(place) > 0)
            disk.fill()
            wait_until(lambda: bool(list(place.glob("blackbox-*.mcap"))))  # it has ended
            shutil.rmtree(place)
            disk.empty()
            wait_until(lambda: box.process.poll() is not None or last_tick(place) > 0)
            status, _, lines = box.end()
    assert status == 0
    assert "the black box tries again" in lines
