"""An experiment on a running fishd, recorded while the fish swims."""

import signal
from pathlib import Path

from rigs.processes import EXPERIMENT, PATIENCE, Daemon, Process, wait_until

from fishd.client import Fish
from fishd.core.errors import RecordingError
from fishd.lab.rerun import rerun
from fishd.lab.session import LiveSession
from fishd.recording import open_run


def test_what_a_live_rig_does_is_rerun_to_the_last_bit(daemon: Daemon, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with (
        Fish(daemon.endpoint, timeout=PATIENCE) as fish,
        LiveSession(fish) as rig,
        rig.recorded(path, "live"),
    ):
        rig.rest(0.5)
        rig.swim("swing", {"C": 0.4}, 1.5)
        rig.rest(0.5)
        rig.swim("square", {"frequency": 1.3}, 1.5)
    run = open_run(path)
    assert run.about["source"] == "fishd"
    assert run.daemons[0]["robot"] == "simulated"
    assert run.gaps == []
    stretches = rerun(run).stretches
    assert [stretch.recorded for stretch in stretches] == ["swing", "square"]
    assert all(stretch.from_start and stretch.equal == stretch.ticks >= 30 for stretch in stretches)


def count_excitation_ticks(part: Path) -> int:
    """Return the number of ticks of the excitation in a recording that is being written."""
    try:
        return open_run(part).summary.swim_ticks.get("excitation", 0)
    except RecordingError:
        return 0


def test_an_ended_experiment_keeps_its_data_and_rests(daemon: Daemon, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    path = folder / "identify.mcap"
    words = ("identify", "--experiment", "--on", "live", "--for", "40", "--folder", str(folder))
    swims = Process(*EXPERIMENT, "--endpoint", daemon.endpoint, *words)
    wait_until(lambda: daemon.status().mode == "running")
    wait_until(lambda: count_excitation_ticks(path.with_name("identify.mcap.part")) >= 15)
    status, out, err = swims.end(signal.SIGTERM)
    assert status == 130
    assert out == f"fish: the fish of fishd at {daemon.endpoint}\n"
    resume = f"fishctl identify --resume {folder}"
    assert err.endswith(f"fishctl: interrupted, before the fit; resume with: {resume}\n")
    assert daemon.status().mode == "idle"
    run = open_run(path)
    assert run.reason == "ended by Interrupted"
    assert run.summary.swim_ticks["excitation"] >= 15
    assert "excitation" in [event.data.get("controller") for event in run.events]
