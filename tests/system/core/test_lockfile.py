"""A lock that one process holds, and that its death ends."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from fishd.core.addresses import claim_address
from fishd.core.errors import StartupError
from fishd.core.process.lockfile import LockHeld, NotALock, find_lock_holder, lock_path, locked

HOLDER = """
import sys, time
from pathlib import Path
from fishd.core.process.lockfile import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_lock_names_the_process_that_holds_it_and_ends_when_it_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "control"
    command = [sys.executable, "-c", HOLDER, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with pytest.raises(LockHeld) as caught, locked(path):
            pass
        assert caught.value.pid == str(process.pid)
        process.kill()
    with locked(path):
        assert lock_path(path).read_text() == f"{os.getpid()}\n"


def test_a_lock_that_is_to_be_removed_is_gone_afterwards_and_held_before(tmp_path: Path) -> None:
    path = tmp_path / "agent"
    with locked(path, remove=True):
        for remove in (True, False):
            with pytest.raises(LockHeld, match=str(os.getpid())), locked(path, remove=remove):
                pass
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_its_holder_removed_while_another_opened_it_is_no_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "agent"

    def late(name: Path, flags: int, mode: int = 0o777) -> int:
        descriptor = really(name, flags, mode)
        if not removed:
            removed.append(name)
            lock_path(path).unlink()  # as a holder does when it ends
        return descriptor

    removed: list[Path] = []
    really = os.open
    monkeypatch.setattr(os, "open", late)
    with locked(path):
        assert removed
        assert lock_path(path).read_text() == f"{os.getpid()}\n"
        with pytest.raises(LockHeld), locked(path):
            pass


PLANTS: dict[str, Callable[[Path, Path], None]] = {
    "a symbolic link": Path.symlink_to,
    "a hard link to another file": Path.hardlink_to,
    "not a regular file": lambda lock, victim: os.mkfifo(lock),
}


@pytest.mark.parametrize("what", PLANTS)
def test_what_was_planted_for_a_lock_is_refused(tmp_path: Path, what: str) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    PLANTS[what](lock_path(tmp_path / "control"), victim)
    with pytest.raises(NotALock, match=what), locked(tmp_path / "control"):
        pass
    # And without a wait for the pipe's other end
    assert find_lock_holder(tmp_path / "control") is None
    assert victim.read_text() == "precious"


def test_a_link_to_a_file_that_is_not_there_makes_none(tmp_path: Path) -> None:
    lock_path(tmp_path / "control").symlink_to(tmp_path / "new")
    with pytest.raises(NotALock), locked(tmp_path / "control"):
        pass
    assert not (tmp_path / "new").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be another user")
def test_a_lock_of_another_user_counts_where_the_folder_is_his(tmp_path: Path) -> None:
    path = tmp_path / "control"
    lock_path(path).write_text("")
    os.chown(lock_path(path), 60101, 60101)
    with pytest.raises(NotALock, match="is a file of user 60101, not a lock file"), locked(path):
        pass
    os.chown(tmp_path, 60101, 60101)
    with locked(path):
        pass


@pytest.mark.parametrize("text", [b"\x1b[31m1", b"1 2", b"9" * 10_000, b""])
def test_bad_pid_is_unknown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: bytes) -> None:
    path = tmp_path / "control"
    # The kernel reports none
    monkeypatch.setattr("fishd.core.process.lockfile._KERNEL_LOCKS", tmp_path / "nowhere")
    with locked(path):
        lock_path(path).write_bytes(text)
        with pytest.raises(LockHeld) as caught, locked(path):
            pass
        assert caught.value.pid in ("unknown", "9" * 20)


def test_two_names_of_one_address_are_one(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with (
        claim_address(f"ipc://{tmp_path}/real/control"),
        pytest.raises(StartupError, match=rf"\(pid {os.getpid()}\) already serves"),
        claim_address(f"ipc://{tmp_path}/link/control"),
    ):
        pass
    assert list((tmp_path / "real").iterdir()) == []
