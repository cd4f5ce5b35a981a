"""Midlines of a swim: few points of each, in the laboratory."""

from pathlib import Path

import numpy as np
import pytest
from rigs.coarse_swimmer import swimmer

from fishd.virtual.swimmer.midlines import POINT_COUNT, Midlines
from fishd.virtual.swimmer.track import Track, save


def test_midlines_are_where_the_body_was_in_the_laboratory() -> None:
    robot = swimmer()
    robot.write(0.42)
    kept = Midlines()
    for tick in range(1, 31):
        robot.read(0.01 * tick)
        kept.add(robot)
    arrays = kept.arrays()
    time, lines = arrays["midline_time"], arrays["midlines"]
    assert time == pytest.approx(0.01 * np.arange(1, 31))
    assert lines.shape == (30, POINT_COUNT, 2)
    fish = robot.fish
    assert lines[-1, 0] == pytest.approx(fish.midline()[0] + (fish.travelled, 0.0), abs=1e-6)
    assert lines[-1, -1] == pytest.approx(fish.midline()[-1] + (fish.travelled, 0.0), abs=1e-6)
    pieces = np.linalg.norm(np.diff(lines, axis=1), axis=2)
    assert pieces.sum(axis=1) == pytest.approx(0.1, rel=0.02)  # it bends, and keeps its length


def test_only_midlines_of_the_same_swim_are_put_before(tmp_path: Path) -> None:
    robot, line, kept = swimmer(), Track(), Midlines()
    for tick in range(1, 4):
        robot.read(0.01 * tick)
        line.add(robot, 0.0)
        kept.add(robot)
    path = tmp_path / "swim.npz"
    save(line, path, kept.arrays())
    rows = line.rows()
    for file, track, count in (
        (path, rows, 3),
        (path, rows + 1e-9, 0),
        (tmp_path / "none.npz", rows, 0),
        (Path(__file__), rows, 0),
    ):
        midlines = Midlines()
        midlines.put_before(file, track)
        assert len(midlines) == count
