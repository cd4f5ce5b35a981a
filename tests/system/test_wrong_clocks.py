"""True fishd and fishctl on a unix clock that is set while they run, or is wrong from the start.

The clock is that of `rigs.wall_clock`: the clock of this machine is not touched.
"""

import json
import os
import subprocess
import time
from pathlib import Path

import pytest
from rigs.processes import FISHCTL, Process, call, wait_until
from rigs.wall_clock import WallClock

from common.daemon import Fishd
from fishd.client import Fish
from fishd.core.errors import RecordingError
from fishd.recording import open_run
from fishd.recording.folder import find_recording


class Rig:
    """A fishd and the commands that share its unix clock."""

    def __init__(self, folder: Path, ahead: float = 0.0) -> None:
        self.runs = folder / "runs"
        self.clock = WallClock(folder / "clock", ahead)
        self.environment = {
            **os.environ, **self.clock.environment, "FISHD_RUNS": str(self.runs)
        }  # fmt: skip
        self.fishd = Fishd(environment=self.clock.environment)

    def words(self, *words: str) -> list[str]:
        return [FISHCTL, *words, "--endpoint", self.fishd.endpoint]

    def fishctl(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a command to its end."""
        return call(FISHCTL, *words, env=self.environment)

    def count_ticks(self, name: str) -> int:
        """Return the number of recorded ticks; 0 before there is a recording."""
        try:
            return len(open_run(find_recording(name, self.runs)).ticks)
        except RecordingError:
            return 0


@pytest.mark.parametrize("step", [-30.0, 86400.0])
def test_a_recording_during_a_step_of_the_clock_is_as_long_as_its_ticks(
    tmp_path: Path, step: float
) -> None:
    rig = Rig(tmp_path)
    rig.fishd.next_tick()
    with rig.fishd, Process(*rig.words("record", "run"), env=rig.environment) as recorder:
        wait_until(lambda: rig.count_ticks("run") > 30)
        rig.clock.set(step)
        with Fish(rig.fishd.endpoint) as fish:
            fish.mark("after the step")
        so_far = rig.count_ticks("run")
        wait_until(lambda: rig.count_ticks("run") > so_far + 30)
        status, out, err = recorder.end()
    assert status == 0
    run = open_run(rig.runs / "run.mcap")
    first, last = run.ticks[0], run.ticks[-1]
    assert run.summary.duration == pytest.approx(last.time - first.time, abs=1e-6)
    (clock_step,) = run.summary.clock_steps
    assert clock_step.by == pytest.approx(step, abs=0.05)
    assert f"fishctl: {clock_step}" in err
    assert f", {len(run.ticks)} ticks" in out
    (mark,) = run.events
    (at,) = run.times_of("event")
    assert at == pytest.approx(mark.time - first.time, abs=1e-6)
    assert clock_step.at - 0.2 <= at <= run.summary.duration
    assert str(clock_step) in rig.fishctl("runs").stdout


def test_fishd_and_its_recordings_work_before_1970(tmp_path: Path) -> None:
    rig = Rig(tmp_path, -time.time() - 5000.0)
    with rig.fishd:
        rig.fishd.next_tick()
        done = call(*rig.words("record", "run", "--for", "1"), env=rig.environment)
        assert (done.returncode, "Traceback" in done.stderr) == (0, False)
        assert "Traceback" not in rig.fishd.log.read_text(encoding="utf-8")
    (listed,) = json.loads(rig.fishctl("runs", "--json").stdout)
    ticks = open_run(rig.runs / "run.mcap").ticks
    assert listed["duration"] == pytest.approx(ticks[-1].time - ticks[0].time, abs=1e-6)
    assert listed["begins"] < 0.0
    assert "1969-12-31 " in rig.fishctl("runs").stdout
    exported = rig.fishctl("export", "run", "--csv", "--to", str(tmp_path))
    assert exported.returncode == 0


def test_the_latest_recording_is_the_one_that_began_last_whatever_the_clock_was(
    tmp_path: Path,
) -> None:
    rig = Rig(tmp_path, 86400.0)
    with rig.fishd:
        rig.fishd.next_tick()
        for name, ahead in (("tomorrow", 86400.0), ("1960", -time.time() - 3e8), ("now", 0.0)):
            rig.clock.set(ahead)
            done = call(*rig.words("record", name, "--for", "0.3"), env=rig.environment)
            assert done.returncode == 0, done.stderr
            os.utime(rig.runs / f"{name}.mcap", (time.time() + ahead,) * 2)
    listed = [run["name"] for run in json.loads(rig.fishctl("runs", "--json").stdout)]
    assert listed == ["tomorrow", "1960", "now"]
    assert find_recording("latest", rig.runs).stem == "now"
