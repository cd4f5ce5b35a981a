"""The second method of `tools/bench swimmer`: finite elements fitted to the body."""

import math
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from bench import swimmer
from fishd.virtual.swimmer.settings import SwimmerSettings

NO_WHEEL = "install the extra 'dev'; ngsolve has no wheel for aarch64"


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1], ids=["along", "across"])
def test_a_pushed_ellipse_moves_with_its_added_mass(axis: int) -> None:
    """Compare with potential flow (Newman, Marine Hydrodynamics, 1977, table 4.3)."""
    body_fitted = pytest.importorskip("bench.body_fitted", reason=NO_WHEEL)
    settings, dt = SwimmerSettings(steering=0.0), 2e-3
    shares = np.sin(np.linspace(0.0, 0.5 * math.pi, 41)) ** 2
    outline = tuple((float(s), math.sqrt(s * (1.0 - s))) for s in shares)
    body = replace(settings.body, young=1e11, thickness=0.02, profile=outline)
    water = replace(settings.water, width=0.8, viscosity=1e-8)
    fish = body_fitted.BodyFitted(replace(settings, body=body, water=water), 4e-3, dt)
    middle = fish.beam.motion(np.zeros(fish.beam.slices))[fish.beam.slices // 2, axis]
    fish.drive = middle  # a force of 1 N/m on the middle, instead of muscles
    for _ in range(2):
        fish.step(1.0)
    half = 0.5 * body.length, 0.5 * body.thickness
    mass = math.pi * water.density * (half[0] * half[1] + half[1 - axis] ** 2)
    assert 2 * dt / float(middle @ fish.state["rate"][0]) == pytest.approx(mass, rel=0.035)


@pytest.mark.slow
def test_both_methods_find_the_same_first_half_beat() -> None:
    pytest.importorskip("ngsolve", reason=NO_WHEEL)
    bends, works = [], []
    for method, size, steps in (("ale", 3.0, 50), ("grid", 1.0, None)):
        fish, half_beat, _ = swimmer.build("damped", method, size, steps)
        for _ in range(half_beat):
            fish.step(1.0)
        _, bend, work = fish.reading()
        bends.append(bend)
        works.append(work)
    assert bends[0] == pytest.approx(bends[1], rel=0.03)
    assert works[0] == pytest.approx(works[1], rel=0.03)


def test_a_kept_run_is_read_as_it_was(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(swimmer, "RUNS", tmp_path / "runs.csv")
    times = np.linspace(0.0, 4.0, 401)
    rows = np.stack([-0.25 * times**2, np.sin(2.0 * math.pi * times), 0.5 * times], axis=1)
    speeds, powers, angles = swimmer.results(rows, 2.0)
    assert speeds == pytest.approx([500.0, 1500.0, 2500.0, 3500.0])
    assert powers == pytest.approx([1000.0] * 4)
    assert angles == pytest.approx([2.0] * 4)
    run = swimmer.Run("damped", "grid", 0.25, 1250, 3, 7.0, speeds, powers, angles)
    with swimmer.RUNS.open("w", encoding="utf-8") as file:
        swimmer.write_rows(file, [run])
    assert swimmer.values_of(swimmer.read_runs()[run[:3]]) == pytest.approx(swimmer.values_of(run))
