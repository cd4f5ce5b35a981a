"""fishctl and fishd under odd conditions: a closed output, a full disk, few file descriptors.

Each command does its work or says in one line why not; an emergency stop works under every one.
"""

import os
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import pytest
from rigs.processes import FISHCTL, FISHD, PATIENCE, Daemon, addresses, call, running, wait_until

from fishd.client import Fish, NoDaemon


class Condition(NamedTuple):
    """Beginning of a shell script, and a redirection of the command after it."""

    setup: str = ":"
    redirect: str = ""
    environment: Mapping[str, str | None] = {}
    """Variables to set, or to remove."""


NO_HOME = {"HOME": None, "XDG_DATA_HOME": None, "XDG_STATE_HOME": None}
CONDITIONS = {
    "the locale C": Condition(
        environment={"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    ),
    "a closed output": Condition(redirect=">&-"),
    "a full output": Condition(redirect=">/dev/full"),
    "a deleted folder": Condition("mkdir gone; cd gone; rmdir ../gone"),
    "no HOME": Condition(environment=NO_HOME),
    "64 open files": Condition("ulimit -n 64"),
    "512 MB of addresses": Condition("ulimit -v 524288"),
    "files of 8 kB": Condition("ulimit -f 16"),
    "a full disk": Condition("mount -t tmpfs -o size=64k none . || exit 125; cd $PWD"),
}
WITHOUT_OUTPUT = ("a closed output", "a full output")
NOT_TRIED = 125
"""Exit status where no file system may be mounted."""


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with running(tmp_path_factory.mktemp("daemon")) as daemon:
        yield daemon


def swim(daemon: Daemon) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.clear_fault()
        fish.set_controller("swing")


def command_under(
    name: str, folder: Path, *words: str, endpoint: str = ""
) -> subprocess.Popen[str]:
    """Start a command under a condition, in a folder."""
    condition = CONDITIONS[name]
    variables = {**os.environ, "FISHD_ENDPOINT": endpoint, **condition.environment}
    for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # few users set these
        variables.pop(threads, None)
    mounting = ["unshare", "--mount"] if "mount" in condition.setup else []
    return subprocess.Popen(
        [*mounting, "sh", "-c", f'{condition.setup}; exec "$@" {condition.redirect}', "sh", *words],
        cwd=folder,
        env={key: value for key, value in variables.items() if value is not None},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )


def finish(process: "subprocess.Popen[str]") -> tuple[int, list[str]]:
    """Return exit status and lines of errors; none of them may be those of a crash."""
    _, err = process.communicate(timeout=PATIENCE)
    if process.returncode == NOT_TRIED:
        pytest.skip("no file system may be mounted here")
    for word in ("Traceback", "Exception ignored", "Fatal Python error", "Assertion failed"):
        assert word not in err
    return process.returncode, err.splitlines()


@pytest.mark.parametrize("condition", CONDITIONS)
def test_an_emergency_stop_passes_and_its_status_says_so(
    condition: str, daemon: Daemon, tmp_path: Path
) -> None:
    swim(daemon)
    status, lines = finish(
        command_under(condition, tmp_path, FISHCTL, "estop", endpoint=daemon.endpoint)
    )
    assert status == 0
    assert bool(lines) == (condition in WITHOUT_OUTPUT)
    assert daemon.status().mode == "estop"


@pytest.mark.parametrize(
    ("words", "condition", "status"),
    [
        ("set-controller square --frequency 1", "the locale C", 0),
        ("mark fin-é", "the locale C", 0),
        ("status", "a closed output", 1),
        ("status --json", "a full output", 1),
        ("controllers", "a full output", 1),
        ("record --for 2 --folder .", "a full disk", 1),
    ],
)
def test_a_command_works_or_says_in_one_line_why_not(
    words: str, condition: str, status: int, daemon: Daemon, tmp_path: Path
) -> None:
    swim(daemon)
    process = command_under(condition, tmp_path, FISHCTL, *words.split(), endpoint=daemon.endpoint)
    ended, lines = finish(process)
    assert (ended, len(lines)) == (status, status), lines


@pytest.mark.parametrize("condition", ["a closed output", "a deleted folder"])
def test_fishd_swims_or_says_in_one_line_why_not(condition: str, tmp_path: Path) -> None:
    words = [FISHD, "--no-print-status", *addresses(tmp_path), "--set", "start.controller=swing"]
    process = command_under(condition, tmp_path, *words)

    def answers_or_ends() -> bool:
        try:
            with Fish(f"ipc://{tmp_path}/control", timeout=1.0) as fish:
                return bool(fish.status().controller)
        except NoDaemon:
            return process.poll() is not None

    wait_until(answers_or_ends)
    process.terminate()
    status, lines = finish(process)
    assert any("stopping" in line for line in lines) if status == 0 else len(lines) == 1
    assert status in (0, 1)


@pytest.mark.parametrize("stream", [">/dev/full", ">&-"])
def test_a_version_that_cannot_be_written_is_one_line(stream: str) -> None:
    done = call("sh", "-c", f'"$0" --version {stream}', FISHD)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("fishd: the output cannot be written: ")


def test_bytes_that_are_no_text_do_not_keep_an_emergency_stop_from_passing(
    daemon: Daemon,
) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert fish.estop(os.fsdecode(b"fin \xff")).mode == "estop"
        reason = fish.status().reason
    assert reason
    assert reason.message == "fin ?"
