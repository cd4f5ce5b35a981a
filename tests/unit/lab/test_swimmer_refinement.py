"""Errors of speeds and of their ratios by the grid: order, limit, and where they are stored."""

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.coarse_swimmer import FILE, OPTIONS, UNDAMPED, coarse
from rigs.processes import fishctl, one_line, sets

from fishd.config import load
from fishd.controllers import registry
from fishd.core.errors import FishdError
from fishd.lab.sweep.grid import Lengths
from fishd.lab.sweep.results import SpeedResult
from fishd.lab.swimmer import refinement
from fishd.lab.swimmer.refinement import GridSpeed, Refinement
from fishd.lab.swimmer.speed import FROM_REST

SHIPPED = FILE.with_name(refinement.FILE)
PARAMETERS = {"frequency": 3.0, "phase": 0.0}


def grids(*speeds: float, ratio: float = 2.0) -> tuple[GridSpeed, ...]:
    """Return speeds on grids, the finest with cells of 1 mm."""
    cells = [1e-3 * ratio**k for k in reversed(range(len(speeds)))]
    pairs = zip(cells, speeds, strict=True)
    return tuple(GridSpeed(cell=cell, step=0.5 * cell, speed=speed) for cell, speed in pairs)


@pytest.mark.parametrize("order", [0.6, 1.2, 2.0, 2.7])
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


def refined(
    controller: str, *speeds: float, fish: object = None, settled: bool = False
) -> Refinement:
    """Return a refinement of the coarse swimmer or of another fish."""
    return Refinement(
        fish=refinement.describe_fish(coarse()) if fish is None else fish,  # type: ignore[arg-type]
        controller=controller,
        parameters=PARAMETERS,
        settled=settled,
        grids=grids(*speeds),
    )


@pytest.fixture
def _no_refinements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@pytest.mark.usefixtures("_no_refinements")
def test_an_error_is_found_for_the_same_fish_and_gait_on_any_grid_as_a_fraction_of_the_speed() -> (
    None
):
    config, finer = coarse(), coarse("swimmer.numerics.cell=0.001", "swimmer.numerics.step=0.0005")
    assert refinement.find_grid_error(config, "square", PARAMETERS) is None
    for speed in (0.12, 0.13):  # the second one replaces the first
        refinement.save(refined("square", 0.10, speed))
    assert refinement.find_grid_error(finer, "square", PARAMETERS) == pytest.approx(0.09 / 0.13)
    assert refinement.find_grid_error(config, "square", PARAMETERS) == pytest.approx(0.18 / 0.10)
    assert refinement.find_grid_error(config, "sine", PARAMETERS) is None
    for other in ("swimmer.muscle.strain=0.9", "estimator.kind=sensor"):
        assert refinement.find_grid_error(coarse(other), "square", PARAMETERS) is None


@pytest.mark.usefixtures("_no_refinements")
@pytest.mark.parametrize("settled_first", [True, False])
def test_a_settled_swim_goes_before_one_from_rest_and_three_grids_before_two(
    settled_first: bool,
) -> None:
    swims = [refined("square", 0.10, 0.13), refined("square", 0.10, 0.12, settled=True)]
    for swim in reversed(swims) if settled_first else swims:
        refinement.save(swim)
    assert [each.settled for each in refinement.find(coarse(), "square", PARAMETERS)] == [
        True,
        False,
    ]
    cells = (2e-3, 1e-3, 5e-4)
    finer = tuple(GridSpeed(cell=cell, step=1e-4, speed=0.1) for cell in cells)
    refinement.save(msgspec.structs.replace(swims[1], grids=finer))
    best, *others = refinement.find(coarse(), "square", PARAMETERS)
    assert (best.grids, len(others)) == (finer, 2)


def test_an_error_that_two_gaits_share_is_not_one_of_their_ratio() -> None:
    square, sine = refined("square", 0.08, 0.10, 0.11), refined("sine", 0.04, 0.05, 0.055)
    assert refinement.relative_error(square.grids, 1e-3) == pytest.approx(1.25 * 0.01 / 0.11)
    assert refinement.ratio_error([sine], [square], 1e-3) == pytest.approx(0.0)
    (ratio,) = refinement.find_ratios(sine, [square])
    assert (ratio.controller, ratio.parameters) == ("square", PARAMETERS)
    assert (ratio.ratio, ratio.grid_error) == pytest.approx((0.5, 0.0))
    sine = refined("sine", 0.04, 0.052, 0.0594)  # 0.50, 0.52 and 0.54 of the other
    assert refinement.ratio_error([sine], [square], 2e-3) == pytest.approx(3.0 * 0.04 / 0.52)


def test_ratios_are_those_to_other_gaits_of_the_same_fish_on_the_same_grids() -> None:
    square, sine = refined("square", 0.10, 0.12), refined("sine", 0.05, 0.08)
    swing = refined("swing", 0.09, 0.11)
    others = [
        refined("triangle", 0.2, 0.3, settled=True),
        refined("triangle", 0.2, 0.3, 0.4),
        refined("triangle", 0.2, 0.3, fish={"another": "fish"}),
    ]
    assert refinement.find_ratios(square, [square, *others]) == []
    ratios = refinement.find_ratios(sine, [swing, square, sine, *others])
    assert [(each.controller, each.ratio) for each in ratios] == [
        ("swing", pytest.approx(0.08 / 0.11)),
        ("square", pytest.approx(0.08 / 0.12)),
    ]
    assert refinement.ratio_error([others[0]], [square], 1e-3) is None


GRID = {"cell": 1e-3, "step": 5e-4, "speed": 0.1}
SWIM = {"fish": {}, "controller": "square", "parameters": {}, "settled": False}
ONE_GRID = SWIM | {"grids": [GRID]}


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


FISH = (*OPTIONS, *sets("swimmer.numerics.cell=0.001", "swimmer.numerics.step=0.0005"))


@pytest.mark.slow
@pytest.mark.usefixtures("_no_refinements")
def test_a_speed_has_its_error_by_the_grid_after_a_refinement() -> None:
    gait = ("sine", "--frequency", "10")
    brief = ("simulate", *gait, *OPTIONS, "--for", "0.5", "--settle", "0.2")
    assert "grid error not known (fishctl swimmer refine)" in fishctl(*brief).stdout
    done = fishctl("swimmer", "refine", *gait, *FISH, "--grids", "2", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    coarsest, finest = report["swims"]["grids"]
    assert (coarsest["cell"], finest["cell"]) == (0.002, 0.001)
    share = report["grid_errors"][0] / coarsest["speed"]
    speed = json.loads(fishctl(*brief, "--json").stdout)["speed"]
    assert f"± {1e3 * abs(share * speed):.2f} by the grid" in fishctl(*brief).stdout


def stub_swims(monkeypatch: pytest.MonkeyPatch, *speeds: float, beats: int = 3) -> list[Lengths]:
    """Replace the next swims by these speeds; return the list of their lengths."""
    lengths: list[Lengths] = []
    results = iter(speeds)

    def swim(point: object, config: object, duration: Lengths, publisher: None) -> SpeedResult:
        lengths.append(duration)
        return SpeedResult(speed=next(results), speed_ci95=1e-4, beats=beats, seconds=24.0)

    monkeypatch.setattr("fishd.cli.swimmer.refine.swim_freely", swim)
    return lengths


@pytest.mark.usefixtures("_no_refinements")
def test_a_refinement_says_what_was_measured_and_the_ratios_to_stored_gaits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refine = ("swimmer", "refine", *FISH, "--frequency", "3")
    lengths = stub_swims(monkeypatch, 0.08, 0.10, 0.11)
    printed = fishctl(*refine, "square").stdout
    assert "order       1.00 observed" in printed
    assert "speed       110.00 mm/s, ± 12.50 by the grid, beats 2 to 4 from rest" in printed
    assert "± 62% on 2 mm, ± 25% on 1 mm, ± 11% on 0.5 mm" in printed
    assert "ratio" not in printed
    stub_swims(monkeypatch, 0.04, 0.05, 0.056)
    printed = fishctl(*refine, "sine").stdout
    assert "ratio       0.509 ± 0.027 by the grid, to square frequency=3 Hz" in printed
    assert set(lengths) == {FROM_REST}
    lengths = stub_swims(monkeypatch, 0.04, 0.05, 0.055)
    printed = fishctl(*refine, "sine", "--settled").stdout
    assert "speed       55.00 ± 0.10 mm/s, ± 6.25 by the grid, steady" in printed
    assert set(lengths) == {Lengths(4.0, 10)}


@pytest.mark.usefixtures("_no_refinements")
@pytest.mark.parametrize(
    ("speed", "beats", "options", "failure"),
    [
        (-0.01, 3, (), "it does not swim forwards yet; try --settled"),
        (-0.01, 3, ("--settled",), "it does not swim forwards"),
        (0.01, 2, (), "it beats less than four times in 24 s"),
    ],
)
def test_a_fish_that_does_not_swim_forwards_has_no_error_by_the_grid(
    monkeypatch: pytest.MonkeyPatch, speed: float, beats: int, options: tuple[str], failure: str
) -> None:
    stub_swims(monkeypatch, speed, beats=beats)
    line = one_line(fishctl("swimmer", "refine", "square", *FISH, "--json", *options))
    assert line == f"fishctl: cells of 2 mm: {failure}\n"
    assert len(refinement.load_all()) == len(json.loads(SHIPPED.read_text()))


def test_a_fish_without_a_grid_cannot_be_refined() -> None:
    line = one_line(fishctl("swimmer", "refine", "square"))
    assert "robot: simulated has no grid; a swimmer is needed" in line
    assert str(FILE.name) in line


@pytest.mark.usefixtures("_no_refinements")
@pytest.mark.parametrize(
    ("file", "controller", "parameters", "error"),
    [
        (UNDAMPED, "square", {"frequency": 3.0}, 0.540),
        (FILE, "square", {"frequency": 2.0}, 0.308),
        (FILE, "sine", {"frequency": 2.0}, 0.410),
        (FILE, "triangle", {"frequency": 2.0}, 1.033),
        (FILE, "swing", {"C": 0.0}, 0.161),
    ],
)
def test_errors_of_the_usual_gaits_are_shipped(
    file: Path, controller: str, parameters: dict[str, Any], error: float
) -> None:
    config = load(file)
    checked = registry.check(controller, parameters, config.limits)
    values = msgspec.structs.asdict(checked)
    assert refinement.find_grid_error(config, controller, values) == pytest.approx(error, abs=1e-3)


@pytest.mark.usefixtures("_no_refinements")
def test_the_shipped_error_of_beats_2_to_4_covers_the_speed_of_finite_elements() -> None:
    config = load(FILE)
    wave = msgspec.structs.asdict(registry.check("square", {"frequency": 2.0}, config.limits))
    (stored,) = refinement.find(config, "square", wave)
    body_fitted = 1e-3 * (16.62 + 26.31 + 35.94) / 3.0
    for grid in stored.grids:
        error = refinement.relative_error(stored.grids, grid.cell) * grid.speed
        assert grid.speed < body_fitted < grid.speed + error
