"""Midlines of a swim: few points of each, in the laboratory."""

import numpy as np
import pytest
from rigs.coarse_swimmer import swimmer

from fishd.virtual.swimmer.midlines import POINT_COUNT, Midlines


def test_midlines_are_where_the_body_was_in_the_laboratory() -> None:
    robot = swimmer()
    robot.write(0.42)
    kept = Midlines()
    for tick in range(1, 31):
        robot.read(0.01 * tick)
        kept.add(robot)
    time, lines = kept.arrays()
    assert time == pytest.approx(0.01 * np.arange(1, 31))
    assert lines.shape == (30, POINT_COUNT, 2)
    fish = robot.fish
    assert lines[-1, 0] == pytest.approx(fish.midline()[0] + fish.travelled, abs=1e-6)
    assert lines[-1, -1] == pytest.approx(fish.midline()[-1] + fish.travelled, abs=1e-6)
    pieces = np.linalg.norm(np.diff(lines, axis=1), axis=2)
    assert pieces.sum(axis=1) == pytest.approx(0.1, rel=0.02)  # it bends, and keeps its length
