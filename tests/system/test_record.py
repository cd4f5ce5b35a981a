"""`fishctl record` on a real fishd: restarts, kills, signals, and a disk that is full."""

import os
import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from rigs.processes import (
    FISHCTL,
    PATIENCE,
    Daemon,
    Process,
    call,
    fishctl,
    one_line,
    running,
    wait_until,
)

from fishd.client import Fish
from fishd.core.errors import RecordingError
from fishd.core.signals import Tick
from fishd.recording import Run, open_run
from fishd.recording.folder import find_recording


class Recording(Process):
    """`fishctl record` beside a daemon."""

    def __init__(self, daemon: Daemon, folder: Path, *words: str) -> None:
        self.folder = folder
        where = ("--endpoint", daemon.endpoint)
        super().__init__(FISHCTL, *where, "record", "--folder", str(folder), *words)

    def wait_for_ticks(self, enough: Callable[[int], bool] = lambda seq: seq > 0) -> None:
        """Wait until the file holds a tick of such a number."""
        wait_until(lambda: any(enough(tick.seq) for tick in ticks_in(self.folder)))


def ticks_in(folder: Path) -> list[Tick]:
    """Return the ticks of the recording that is being written, none if it does not exist yet."""
    run = open_unfinished(folder)
    return run.ticks if run else []


def open_unfinished(folder: Path) -> Run | None:
    """Return the recording that is being written, None if it does not exist yet."""
    try:
        return open_run(next(folder.glob("*.part")))
    except (StopIteration, RecordingError):
        return None


def count_daemons(folder: Path) -> int:
    """Return the number of fishds of which the recording in progress holds the configuration."""
    run = open_unfinished(folder)
    return len(run.configs) if run else 0


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    folder = tmp_path / "runs"
    folder.mkdir()
    return folder


def test_what_lets_a_fish_in_estop_swim_is_named(daemon: Daemon, runs: Path) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.estop()
        done = daemon.fishctl("record", "run", "--folder", str(runs), "--for", "0.5")
        fish.clear_fault()
    assert done.stderr.splitlines()[-1] == (
        "fishctl: the fish is at rest (mode estop); it swims with: fishctl clear-fault, then "
        "fishctl set-controller"
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_finishes_the_file(daemon: Daemon, runs: Path, number: signal.Signals) -> None:
    words = ("run", "--subject", "fish 3", "--operator", "Ada", "--note", "stiff fin")
    recording = Recording(daemon, runs, *words)
    recording.wait_for_ticks()
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.set_controller("swing")
        fish.set_parameters(C=0.3)
        fish.mark("a push")
        swims = fish.status().seq + 30
    recording.wait_for_ticks(lambda seq: seq > swims)
    status, out, complaints = recording.end(number)
    assert status == 0
    remark = "fishctl: the fish is at rest (mode idle); it swims with: fishctl set-controller"
    assert complaints.splitlines() == [remark]
    assert re.search(r"^run\.mcap: [0-9.]+ s, \d+ ticks, 0 lost, \d+ events, \d+ kB$", out, re.M)
    run = open_run(runs / "run.mcap")
    assert run.finished
    assert run.reason == "stopped"
    assert (run.about["subject"], run.about["operator"]) == ("fish 3", "Ada")
    kinds = [event.kind for event in run.events if event.kind != "overrun"]
    assert kinds == ["controller", "mode", "parameters", "mark"]
    assert run.statuses
    assert run.config.robot == "simulated"
    assert int(run.daemons[0]["pid"]) == daemon.process.pid
    done = fishctl("rerun", "run", "--folder", str(runs))
    assert done.returncode == 0, done.stdout
    assert re.search(r"all \d+ of \d+ commands equal to the last bit", done.stdout)


def test_a_kill_of_fishd_loses_nothing_and_the_next_is_recorded(tmp_path: Path, runs: Path) -> None:
    with running(tmp_path, "--set", "start.controller=swing") as first:
        recording = Recording(first, runs, "run")
        recording.wait_for_ticks()
        with Fish(first.endpoint, timeout=PATIENCE) as fish:
            ticks = (tick.seq for tick in fish.ticks())
            heard = [seq for _, seq in zip(range(15), ticks, strict=False)]
        # The next fishd is received at a lower tick number, even on a busy machine.
        wait_until(lambda: first.status().seq > 150)
        first.kill()
    with running(tmp_path, "--set", "start.controller=square"):
        wait_until(lambda: count_daemons(runs) == 2)
        _, _, complaints = recording.end()
    run = open_run(runs / "run.mcap")
    assert "another fishd has taken over: the recording continues with it" in complaints
    before = [tick.seq for tick in run.ticks if tick.controller == "swing"]
    assert before[-1] >= heard[-1]
    assert before == list(range(before[0], before[-1] + 1))
    assert run.summary.restarts == 1
    assert {run.config_of(n).start.controller for n in (0, 1)} == {"swing", "square"}
    lost = [gap.lost for gap in run.gaps]
    assert lost == [] or (run.gaps[0].seq, len(lost)) == (1, 1)  # at most its first ones
    assert f"ticks were lost: {lost[0]}" in complaints if lost else True


def test_a_kill_of_the_recorder_leaves_a_file_to_recover(daemon: Daemon, runs: Path) -> None:
    recording = Recording(daemon, runs, "run")
    recording.wait_for_ticks()
    wait_until(lambda: daemon.status().seq - ticks_in(runs)[-1].seq < 20)  # a second
    there = ticks_in(runs)
    recording.end(signal.SIGKILL)
    ticks = open_run(runs / "run.mcap.part").ticks
    assert ticks[: len(there)] == there
    listed = fishctl("runs", "--folder", str(runs))
    assert re.search(r"^run .* unfinished", listed.stdout, re.MULTILINE)
    done = fishctl("recover", "run", "--folder", str(runs))
    assert done.stdout.startswith(f"{runs}/run.mcap: ")
    assert open_run(runs / "run.mcap").ticks == ticks
    assert find_recording("latest", runs) == runs / "run.mcap"


def test_a_full_disk_ends_the_recording_and_fishd_is_told(daemon: Daemon, runs: Path) -> None:
    before = daemon.status()
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        events = fish.events()
        limit = f"ulimit -f 16; exec {FISHCTL} --endpoint {daemon.endpoint} record run"
        # Python would also write compiled modules that are cut off at the limit.
        uncompiled = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
        ended = call("bash", "-c", f"{limit} --folder {runs}", env=uncompiled)
        mark = next(event for event in events if event.kind == "mark")
    _, complaint = ended.stderr.splitlines()
    assert "File too large; the written part is readable; free some space, then run" in complaint
    assert ended.returncode == 1
    assert mark.message.startswith("recording run.mcap ended: ")
    assert len(open_run(runs / "run.mcap.part").ticks) > 10
    after = daemon.status()
    assert after.pid == before.pid
    assert after.seq > before.seq


def test_where_there_is_no_fishd_or_the_name_is_taken_nothing_is_begun(
    daemon: Daemon, runs: Path, tmp_path: Path
) -> None:
    nobody = fishctl("--endpoint", f"ipc://{tmp_path}/none", "record", "--folder", str(runs))
    assert "start one with 'fishd'" in one_line(nobody)
    (runs / "run.mcap").touch()
    taken = daemon.fishctl("record", "run", "--folder", str(runs))
    assert "already exists; choose another name" in one_line(taken)
    assert [path.name for path in runs.iterdir()] == ["run.mcap"]


def test_the_black_box_waits_for_a_fishd(tmp_path: Path, runs: Path) -> None:
    environment = os.environ | {"STATE_DIRECTORY": str(runs), "FISHD_RUNS": ""}
    command = (FISHCTL, "--endpoint", f"ipc://{tmp_path}/control", "record", "--black-box")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        box = Process(*command, "--keep", "10MB")
    with running(tmp_path):
        wait_until(lambda: bool(ticks_in(runs)))
        assert box.end()[0] == 0
    assert open_run(next(runs.glob("blackbox-*.mcap"))).ticks
