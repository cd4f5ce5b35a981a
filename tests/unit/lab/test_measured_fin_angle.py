"""The largest fin angle that a camera measures, in the results of experiments."""

import re
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rigs.seen_tail import SeenTail

from fishd.cli.compare import _make_table
from fishd.cli.sweep import _format_result
from fishd.config import load
from fishd.core.tail_reading import RecordedTail
from fishd.lab.compare.live import LiveComparison
from fishd.lab.error_budget import format_fin_angle
from fishd.lab.fin_angle import FinAngles
from fishd.lab.measurement import measure
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import simulate
from fishd.lab.sweep.grid import Point
from fishd.lab.sweep.measuring import measure_point
from fishd.lab.sweep.results import select_quantity
from fishd.recording import open_run

SQUARE = {"frequency": 1.0, "amplitude": 0.3}


def session(**camera: float) -> VirtualSession:
    """Return a session with a camera that measures the fin angle."""
    opened = VirtualSession(load())
    opened.fin_angles = FinAngles(SeenTail(opened, **camera), warn=pytest.fail)
    opened._listeners.append(opened.fin_angles)
    return opened


@pytest.fixture(scope="module")
def truth() -> float:
    """Mean over half beats of the largest true fin angle [rad]."""
    return simulate(load(), "square", SQUARE).fin_amplitude


def test_a_thrust_comes_with_the_largest_fin_angle_and_its_interval(truth: float) -> None:
    with session() as rig:
        measured = measure(rig, "square", SQUARE, 21.0)
    assert measured.fin_angle_max == pytest.approx(truth, rel=0.01)
    assert measured.fin_angle_max_ci95
    assert abs(measured.fin_angle_max - truth) < 3.0 * measured.fin_angle_max_ci95
    assert measured.fin_angle_max_ci95 < 0.01 * truth
    assert format_fin_angle(measured).endswith(" mrad")
    assert measured.summary().fin_angle_max == measured.fin_angle_max


def test_a_comparison_and_a_sweep_have_it_too(truth: float) -> None:
    with session() as rig:
        comparison = LiveComparison(rig, ["square:frequency=1,amplitude=0.3", "hold"])
        comparison.swim(21.0, runs=2)
        standing, resting = comparison.standings()
        result = measure_point(Point("square", SQUARE, {}), rig, 21.0)
    assert standing.fin_angle_max == pytest.approx(truth, rel=0.01)
    assert result.fin_angle_max == pytest.approx(truth, rel=0.01)
    assert result.fin_angle_max_ci95
    assert resting.fin_angle_max is None
    assert format_fin_angle(resting) == ""
    output = StringIO()
    Console(file=output, width=200).print(_make_table([standing, resting], "N"))
    heads, swum, rested = output.getvalue().splitlines()
    assert "fin mrad" in heads
    assert "156." in swum
    assert "–" in rested
    line = _format_result(result, select_quantity("live", {}, "N"))
    assert re.search(r"1\.00 Hz, largest fin angle 15\d\.\d+ ± \d\.\d+ mrad$", line)


def test_unknown_fin_angles_are_counted_with_their_reason(truth: float) -> None:
    warnings: list[str] = []
    with session() as rig:
        seen = rig._listeners[0]
        assert isinstance(seen, SeenTail)
        seen.glare = 0.25
        rig.fin_angles = FinAngles(seen, warnings.append)
        rig._listeners[1] = rig.fin_angles
        measured = measure(rig, "square", SQUARE, 21.0)
    assert measured.fin_angle_max == pytest.approx(truth, rel=0.02)
    (warning,) = warnings
    assert warning.endswith(" fin angles are unknown: glare")


def test_without_a_camera_there_is_none() -> None:
    with VirtualSession(load()) as rig:
        result = measure_point(Point("square", SQUARE, {}), rig, 21.0)
    assert result.fin_angle_max is None
    assert result.fin_angle_max_ci95 is None


def test_a_recording_has_them_and_a_resumed_experiment_reads_them(
    tmp_path: Path, truth: float
) -> None:
    path = tmp_path / "measure.mcap"
    with session() as rig, rig.recorded(path, "a test"):
        first = measure(rig, "square", SQUARE, 21.0)
    run = open_run(path)
    assert len(run.tails) > 500
    assert run.problem == ""

    class Nothing:
        def set_time(self, *_: Any) -> None: ...

        def take(self) -> tuple[list[str], list[Any]]:
            return ["the camera is back: its frames are recorded"], []

        def take_tails(self) -> list[RecordedTail]:
            return []

    warnings: list[str] = []
    fin_angles = FinAngles(Nothing(), warnings.append)
    fin_angles.tick(run.ticks[0])
    assert warnings == ["the camera is back: its frames are recorded"]
    assert fin_angles.find_maximum(run.ticks, 1.5) == {}
    assert warnings[1:] == ["0 of 0 fin angles are unknown: the camera sends too few"]
    fin_angles.read([path])
    assert fin_angles.find_maximum(run.ticks, 1.5)["fin_angle_max"] == pytest.approx(
        first.fin_angle_max
    )
