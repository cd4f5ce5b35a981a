"""A lock that one process holds, and that its death ends."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fishd.lockfile import Taken, lock_path, locked

HOLDER = """
import sys, time
from pathlib import Path
from fishd.lockfile import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_lock_names_the_process_that_holds_it_and_ends_when_that_is_killed(
    tmp_path: Path,
) -> None:
    path = tmp_path / "control"
    command = [sys.executable, "-c", HOLDER, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(Taken) as caught, locked(path):
            pass
        assert caught.value.pid == str(holder.pid)
        holder.kill()
    with locked(path):
        assert lock_path(path).read_text() == f"{os.getpid()}\n"


def test_a_holder_without_a_name_is_unknown(tmp_path: Path) -> None:
    path = tmp_path / "control"
    with locked(path):
        lock_path(path).write_text("")
        with pytest.raises(Taken) as caught, locked(path):
            pass
    assert caught.value.pid == "unknown"


def test_a_lock_that_is_to_be_removed_is_gone_afterwards_and_held_before(tmp_path: Path) -> None:
    path = tmp_path / "agent"
    with locked(path, remove=True):
        with pytest.raises(Taken, match=str(os.getpid())), locked(path, remove=True):
            pass
        with pytest.raises(Taken), locked(path):
            pass
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_its_holder_removed_while_another_opened_it_is_no_lock(tmp_path: Path) -> None:
    path = tmp_path / "agent"

    def late(name: str, flags: int) -> int:
        found = os.open(name, flags)
        if not removed:
            removed.append(name)
            lock_path(path).unlink()  # as a holder does that ends now
        return found

    removed: list[str] = []
    with locked(path, late):
        assert lock_path(path).read_text() == f"{os.getpid()}\n"
        with pytest.raises(Taken), locked(path):
            pass
