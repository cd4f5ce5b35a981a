"""A controller that chooses again on what was recorded gives the very same commands."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from rigs.harness import Rig, fragile_rig
from rigs.recordings import record_run, status
from rigs.reversed_force import reversed_robot

from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.core.errors import ParameterError, RecordingError
from fishd.lab.rerun import Rerun, rerun
from fishd.recording import RunWriter, open_run


def rerun_of(rig: Rig, path: Path) -> Rerun:
    return rerun(open_run(record_run(rig, path, source="simulation")))


@pytest.mark.parametrize(
    ("controller", "parameters", "change"),
    [
        ("swing", {"C": 0.7}, {"C": 0.4}),
        ("square", {"frequency": 1.63}, {"frequency": 2.2}),
        ("sine", {"frequency": 1.63}, {"amplitude": 0.2}),
        ("thrust", {"target": 0.01}, {"target": 0.015}),
        ("ppo", {"policy": "default-fish"}, {}),
    ],
)
def test_every_command_and_every_estimate_comes_out_to_the_last_bit(
    tmp_path: Path, controller: str, parameters: dict[str, object], change: dict[str, object]
) -> None:
    rig = Rig("simulation.noise=0.002", "simulation.drift=0.005", "slew_limit=9")
    rig.run(7)
    rig.start(controller, **parameters)
    rig.run_for(5)
    rig.run(missed=3)
    if change:
        rig.retune(**change)
    rig.run_for(5)
    rig.loop.stop()
    rig.run_for(1)
    rig.start("swing")
    rig.run_for(2)
    result = rerun_of(rig, tmp_path / "run")
    assert [stretch.recorded for stretch in result.stretches] == [controller, "swing"]
    for stretch in result.stretches:
        assert stretch.from_start
        assert (stretch.equal, stretch.largest) == (stretch.ticks, 0.0)
    assert sum(stretch.ticks for stretch in result.stretches) == 241
    assert result.estimates.from_start
    assert result.estimates.equal == result.estimates.ticks == len(rig.recorder.ticks)


@pytest.mark.parametrize("kind", ["lateral_force", "observer"])
def test_a_reversed_force_that_was_corrected_is_corrected_again(tmp_path: Path, kind: str) -> None:
    rig = Rig(f"estimator.kind={kind}", wrap=reversed_robot)
    rig.run_for(3)
    rig.start("swing")
    rig.run_for(5)
    assert rig.loop.perception.estimator.fy_corrected
    result = rerun_of(rig, tmp_path / "run")
    assert [(stretch.equal, stretch.ticks) for stretch in result.stretches] == [(100, 100)]
    assert result.estimates.equal == result.estimates.ticks == len(rig.recorder.ticks)


def test_a_thrust_that_was_held_by_a_measured_factor_is_held_by_it_again(tmp_path: Path) -> None:
    rig = Rig("simulation.noise=0.002")
    rig.loop.perception.thrust.calibrate(68.0, 0.5)
    rig.start("thrust", target=0.01)
    rig.run_for(10)
    stretch = rerun_of(rig, tmp_path / "run").stretches[0]
    assert (stretch.equal, stretch.ticks) == (200, 200)


def test_the_observer_is_rerun_and_sees_another_fish_where_asked(tmp_path: Path) -> None:
    rig = Rig("estimator.kind=observer", "simulation.noise=0.002").start("swing")
    rig.run_for(10)
    run = open_run(record_run(rig, tmp_path / "run"))
    result = rerun(run)
    assert result.stretches[0].equal == result.estimates.equal == 200
    changed = rerun(run, overrides=["plant.omega0=9"])
    assert changed.stretches[0].equal < 200


def test_a_swim_before_the_recording_began_has_an_unknown_past(tmp_path: Path) -> None:
    rig = Rig().start("swing", C=0.4)
    rig.run_for(20)
    with RunWriter(tmp_path / "run") as writer:
        writer.describe(rig.config)
        for tick in rig.recorder.ticks[100:]:
            writer.tick(tick)
    result = rerun(open_run(writer.path), "swing", {"C": 0.4})
    (stretch,) = result.stretches
    assert not stretch.from_start
    assert not result.estimates.from_start
    assert stretch.ticks == 299  # without the first, whose time since the previous tick is unknown
    assert stretch.equal >= 295  # after its first reversal, swing does not depend on the past


def test_another_fishd_is_judged_with_its_own_configuration(tmp_path: Path) -> None:
    first, second = Rig(), Rig("slew_limit=4")
    first.run(10)
    second.start("swing")
    second.run_for(20)
    with RunWriter(tmp_path / "run") as writer:
        for pid, rig, heard in ((1, first, 0), (2, second, 30)):
            ticks = rig.recorder.ticks[heard:]
            for tick in ticks[:8]:
                writer.tick(tick)
            writer.status(status(ticks[7], pid))
            writer.describe(rig.config)
            for tick in ticks[8:]:
                writer.tick(tick)
    run = open_run(writer.path)
    assert (run.summary.restarts, [gap.lost for gap in run.gaps]) == (1, [20])
    before, stretch = rerun(run).stretches
    assert (before.ticks, stretch.seq, stretch.from_start) == (7, 40, False)
    assert (stretch.equal, stretch.ticks) == (361, 361)


def test_another_controller_sees_what_the_recorded_one_saw(tmp_path: Path) -> None:
    rig = Rig().start("square", frequency=1.667)
    rig.run_for(10)
    run = open_run(record_run(rig, tmp_path / "run"))
    (stretch,) = rerun(run, "swing", {"C": 0.6}).stretches
    assert (stretch.recorded, stretch.controller) == ("square", "swing")
    assert 0 < stretch.equal < stretch.ticks
    with pytest.raises(ParameterError, match="C: 7 is not valid"):
        rerun(run, "swing", {"C": 7})
    with pytest.raises(RecordingError, match="'remote' has no rerun"):
        rerun(run, "remote")


def test_a_fault_and_what_follows_it_are_rerun_too(tmp_path: Path) -> None:
    rig, robot = fragile_rig()
    rig.start("swing")
    rig.run_for(3)
    robot.fy, robot.suspect = 5.0, "clipped"
    rig.run(1)
    robot.fy, robot.suspect = None, ""
    rig.run_for(3)
    robot.fy, robot.suspect = 5.0, "clipped"
    rig.run(4)
    assert rig.mode == "fault"
    robot.fy, robot.suspect = None, ""
    rig.run_for(1)
    rig.loop.clear_fault()
    rig.start("swing", C=0.2)
    rig.run_for(3)
    result = rerun_of(rig, tmp_path / "run")
    assert [stretch.parameters["C"] for stretch in result.stretches] == [0.6, 0.2]
    assert all(stretch.equal == stretch.ticks for stretch in result.stretches)
    assert result.estimates.equal == result.estimates.ticks


def test_a_new_zero_of_the_force_sensor_is_one_for_the_rerun_too(tmp_path: Path) -> None:
    rig, robot = fragile_rig()
    robot.fy = 1.0
    rig.run_for(3)
    robot.fy = None
    rig.loop.perception.forget_force(scale=False)
    rig.loop.reporter.event("calibration", "force sensor: a.yaml", file="a.yaml")
    rig.run_for(1)
    rig.start("swing")
    rig.run_for(3)
    result = rerun_of(rig, tmp_path / "run")
    assert result.estimates.equal == result.estimates.ticks


@pytest.mark.parametrize(("source", "virtual"), [("fishd", False), ("simulation", True)])
def test_time_stands_still_for_a_controller_only_where_it_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, virtual: bool
) -> None:
    rig = Rig().start("swing")
    rig.run_for(1)
    path = record_run(rig, tmp_path / "run", source=source)
    seen = []

    def create(name: str, parameters: dict[str, object], limits: Limits) -> object:
        seen.append(limits.virtual)
        return registry.create(name, parameters, limits)

    monkeypatch.setattr("fishd.lab.rerun.registry", SimpleNamespace(create=create))
    rerun(open_run(path))
    assert seen == [virtual]
