"""Error of a speed by the grid: its order, its limit, and where it is stored and total."""

import json
from pathlib import Path

import pytest
from rigs.coarse_swimmer import FILE, OPTIONS, UNDAMPED, coarse
from rigs.processes import fishctl, one_line, sets

from fishd.config import load
from fishd.core.errors import FishdError
from fishd.lab.swimmer import refinement
from fishd.lab.swimmer.refinement import GridSpeed, Refinement

PARAMETERS = {"frequency": 3.0, "phase": 0.0}


def grids(*speeds: float, ratio: float = 2.0) -> tuple[GridSpeed, ...]:
    """Return speeds on grids, the finest with cells of 1 mm."""
    cells = [1e-3 * ratio**k for k in reversed(range(len(speeds)))]
    pairs = zip(cells, speeds, strict=True)
    return tuple(GridSpeed(cell=cell, step=0.5 * cell, speed=speed) for cell, speed in pairs)


@pytest.mark.parametrize("order", [1.2, 2.0, 2.7])
@pytest.mark.parametrize("ratio", [1.5, 2.0])
def test_speeds_that_converge_show_their_order_and_up_to_the_second_their_limit(
    order: float, ratio: float
) -> None:
    speeds = [0.13 - 0.004 * ratio ** (k * order) for k in (2, 1, 0)]
    total = refinement.estimate(grids(*speeds, ratio=ratio))
    assert total.order == pytest.approx(order)
    assert total.is_converging
    if order <= 2.0:
        assert total.limit == pytest.approx(0.13)
        assert total.error(1e-3) == pytest.approx(1.25 * 0.004)
        assert total.error(ratio * 1e-3) == pytest.approx(1.25 * 0.004 * ratio**order)


@pytest.mark.parametrize("speeds", [(0.09, 0.105, 0.119), (0.10, 0.12, 0.11), (0.10, 0.11, 0.13)])
def test_speeds_that_do_not_converge_have_three_times_their_last_change_as_error(
    speeds: tuple[float, float, float],
) -> None:
    total = refinement.estimate(grids(*speeds))
    assert not total.is_converging
    assert total.error(1e-3) == pytest.approx(3.0 * abs(speeds[2] - speeds[1]))


def test_two_grids_are_of_first_order_with_a_larger_factor_of_safety() -> None:
    total = refinement.estimate(grids(0.10, 0.13))
    assert (total.order, total.used_order) == (None, 1.0)
    assert total.limit == pytest.approx(0.16)
    assert total.error(1e-3) == pytest.approx(3.0 * 0.03)


def test_steps_of_all_grids_fit_into_a_tick() -> None:
    config = coarse("swimmer.numerics.cell=0.0005", "swimmer.numerics.step=0.0004")
    cells, steps = zip(*refinement.choose_grids(config, 3), strict=True)
    assert cells == pytest.approx([1e-3, 5e-4, 2.5e-4])
    assert [config.tick / step for step in steps] == pytest.approx([13, 25, 50])


def test_an_error_is_found_for_the_same_fish_and_gait_on_any_grid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    config, finer = coarse(), coarse("swimmer.numerics.cell=0.001", "swimmer.numerics.step=0.0005")
    assert refinement.find_grid_error(config, "square", PARAMETERS) is None
    fish = refinement.describe_fish(config)
    for speed in (0.12, 0.13):  # the second one replaces the first
        refinement.save(
            Refinement(
                fish=fish, controller="square", parameters=PARAMETERS, grids=grids(0.10, speed)
            )
        )
    assert refinement.find_grid_error(finer, "square", PARAMETERS) == pytest.approx(0.09)
    assert refinement.find_grid_error(config, "square", PARAMETERS) == pytest.approx(0.18)
    assert refinement.find_grid_error(config, "sine", PARAMETERS) is None
    other = coarse("swimmer.muscle.strain=0.9")
    assert refinement.find_grid_error(other, "square", PARAMETERS) is None


GRID = {"cell": 1e-3, "step": 5e-4, "speed": 0.1}
ONE_GRID = {"fish": {}, "controller": "square", "parameters": {}, "grids": [GRID]}


@pytest.mark.parametrize("content", ["[{]", json.dumps([ONE_GRID])])
def test_a_damaged_file_of_refinements_is_named_before_a_swim_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    path, swim = tmp_path / "fishd" / refinement.FILE, tmp_path / "swim.npz"
    path.parent.mkdir()
    path.write_text(content)
    with pytest.raises(FishdError, match="remove it and run fishctl swimmer refine again") as error:
        refinement.find_grid_error(coarse(), "square", PARAMETERS)
    assert str(path) in str(error.value)
    times = ("--for", "0.2", "--settle", "0.1")
    line = one_line(fishctl("simulate", "square", *OPTIONS, *times, "--to", str(swim)))
    assert str(path) in line
    assert not swim.exists()


@pytest.mark.slow
def test_a_speed_has_its_error_by_the_grid_after_a_refinement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(
        "fishd.lab.swimmer.speed.MAX_SWIM_S", 0.4
    )  # any speed has an error by the grid
    fish = (*OPTIONS, *sets("swimmer.numerics.cell=0.001", "swimmer.numerics.step=0.0005"))
    gait = ("sine", "--frequency", "10")
    brief = ("simulate", *gait, *OPTIONS, "--for", "0.5", "--settle", "0.2")
    assert "grid error not known (fishctl swimmer refine)" in fishctl(*brief).stdout
    options = ("--grids", "2", "--settle", "0", "--periods", "2", "--json")
    done = fishctl("swimmer", "refine", *gait, *fish, *options)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert [each["cell"] for each in report["swims"]["grids"]] == [0.002, 0.001]
    error = report["grid_errors"][0]
    assert f"± {1e3 * error:.2f} by the grid" in fishctl(*brief).stdout


def test_a_fish_without_a_grid_cannot_be_refined() -> None:
    line = one_line(fishctl("swimmer", "refine", "square"))
    assert "robot: simulated has no grid; a swimmer is needed" in line
    assert str(FILE.name) in line


def test_the_error_of_the_square_wave_of_the_undamped_fish_is_shipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    wave = {"frequency": 3.0, "amplitude": None}
    assert refinement.find_grid_error(load(UNDAMPED), "square", wave) == pytest.approx(
        0.079, abs=1e-3
    )
