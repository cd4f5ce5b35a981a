"""Recordings of a rig, written while it swims, with everything that a rerun needs."""

import re
from pathlib import Path

import pytest
from rigs.processes import fishctl, sets

from fishd.config import Config, load
from fishd.core.errors import RecordingError
from fishd.core.signals import Event, Tick
from fishd.lab.identification import Unidentifiable, identify
from fishd.lab.rerun import rerun
from fishd.lab.run_traces import traces
from fishd.lab.session import VirtualSession
from fishd.recording import open_run


def test_every_swim_of_a_rig_is_rerun_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with VirtualSession(load("config/simulated.yaml")) as rig, rig.recorded(path, "two swims"):
        rig.rest(2.0)
        for controller, parameters in (("swing", {"C": 0.4}), ("square", {"frequency": 1.3})):
            rig.swim(controller, parameters, 5.0)
            rig.rest(3.0)
    run = open_run(path)
    assert [run.about[key] for key in ("source", "note")] == ["simulation", "two swims"]
    assert [event.kind for event in run.events].count("controller") == 2
    result = rerun(run)
    assert [stretch.recorded for stretch in result.stretches] == ["swing", "square"]
    assert [stretch.parameters.get("C") for stretch in result.stretches] == [0.4, None]
    stretches = result.stretches
    assert all(s.from_start and s.equal == s.ticks for s in stretches)
    assert result.estimates.equal == result.estimates.ticks == len(run.ticks) == 360


class FullDisk:
    """Listener that fails as a full disk does, after some ticks."""

    def __init__(self, room: int) -> None:
        self._room = room

    def tick(self, _: Tick) -> None:
        self._room -= 1
        if not self._room:
            raise RecordingError("no room")

    def event(self, _: Event) -> None:
        """Accept the event."""


def test_a_recording_that_fails_ends_a_swim_and_is_no_fault_of_the_fish() -> None:
    with (
        VirtualSession(Config()) as rig,
        rig.heard_by(FullDisk(50)),
        pytest.raises(RecordingError, match="no room"),
    ):
        rig.swim("swing", {}, 10.0)


def test_what_swam_before_a_kill_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.mcap"
    monkeypatch.setattr("fishd.lab.session.FLUSH_INTERVAL_S", 0.0)

    def swim() -> None:
        with VirtualSession(Config()) as rig, rig.recorded(path, "") as writer:
            rig.swim("swing", {}, 5.0)
            assert open_run(writer.part).summary.swim_ticks == {"swing": 100}
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        swim()
    run = open_run(path)
    assert run.reason == "ended by KeyboardInterrupt"
    assert run.summary.swim_ticks == {"swing": 100}


def test_forces_in_volts_are_never_called_newtons(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    config = load("config/virtual-pi.yaml", [f"state_folder={tmp_path}"])
    with VirtualSession(config) as rig, rig.recorded(path, ""):
        rig.swim("swing", {}, 10.0)
    run = open_run(path)
    assert (rig.unit, run.summary.force_unit, traces(run).unit) == ("V", "V", "mV")
    listed = fishctl("runs", "--folder", str(tmp_path)).stdout
    assert re.search(r"^run .* -?\d+\.\d\d ± \S+ mV ", listed, re.MULTILINE)
    with pytest.raises(Unidentifiable, match=r"run.mcap: its forces are in V, not in newtons"):
        identify(path)


@pytest.mark.slow
def test_a_simulated_run_says_what_its_forces_are_in(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    words = ("--config", "config/virtual-pi.yaml", *sets(f"state_folder={tmp_path}"))
    done = fishctl("simulate", "swing", "--seconds", "11", *words, "--record", str(path))
    assert done.returncode == 0, done.stderr
    assert open_run(path).summary.force_unit == "V"
