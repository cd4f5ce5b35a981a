"""Sweeps: measured once, kept, resumed, and safe to interrupt."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from errno import ENOSPC
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import msgspec
import pytest
from rigs.policy_files import write
from rigs.processes import fishctl, one_line

from fishd.config import Config, load
from fishd.core.errors import ConfigError, FishdError, RecordingError
from fishd.core.signals import Tick
from fishd.lab.experiment import Header, open_experiment
from fishd.lab.parallel import FileStop
from fishd.lab.rerun import rerun
from fishd.lab.session import Disturbed, VirtualSession
from fishd.lab.sweep.curves import WholeTicks, find_best_of_whole_ticks, make_curves
from fishd.lab.sweep.grid import MAX_POINTS, Lengths, Point
from fishd.lab.sweep.measuring import Task, measure_all, simulate_point, swim
from fishd.lab.sweep.results import Result, SweepFolder, select_quantity
from fishd.recording import open_run

DRIFTS = ("simulation.noise=0.001", "simulation.drift=0.005", "simulation.offset_y=0.01")
MEASURED = select_quantity("live", {}, "N").measured
SQUARES = [Point("square", {"frequency": value}) for value in (1.25, 5.0 / 3.0, 2.0)]


def open_folder(
    path: Path,
    config: Config | None = None,
    seconds: float = 21.0,
    columns: Sequence[str] = ("controller", "parameters.frequency"),
) -> SweepFolder:
    """Create the folder of a sweep, or open it again if it exists."""
    settings = {"lengths": {"seconds": seconds}}
    plain = msgspec.to_builtins(config or load())
    header = Header(kind="sweep", on="live", config=plain, settings=settings)
    with open_experiment(path, header, resume=(path / "experiment.json").exists()) as experiment:
        return SweepFolder(experiment, columns)


def measure(folder: SweepFolder, points: Sequence[Point], session: VirtualSession) -> None:
    with session:
        list(measure_all(folder, points, session, 21.0))


def test_a_simulated_fish_is_judged_by_its_true_thrust_whatever_its_sensor_says() -> None:
    for frequency, millinewtons in ((1.0, 15.234453), (2.0, 23.829169)):  # from tests/reference
        point = Point("square", {"frequency": frequency})
        result = swim(point, load(None, DRIFTS), Lengths(), None)
        assert result.thrust == pytest.approx(millinewtons * 1e-3, rel=1e-4)
        assert result.thrust_ci95 == pytest.approx(0.0, abs=1e-9)


def test_a_long_point_stops_within_a_few_ticks() -> None:
    stops = iter([False, False, True])
    point = Point("square", {"frequency": 0.001})
    assert swim(point, Config(), Lengths(periods=10_000), None, stop=lambda: next(stops)) is None


def test_half_beats_that_are_no_whole_ticks_show_in_the_error() -> None:
    result = swim(Point("square", {"frequency": 1.709}), Config(), Lengths(), None)
    assert result
    assert result.thrust is not None
    assert result.thrust_ci95 is not None
    assert 1e-6 < result.thrust_ci95 < 1e-3
    assert result.thrust == pytest.approx(25.6e-3, abs=result.thrust_ci95)


def test_a_rig_that_drifts_is_measured_point_by_point_and_recorded(tmp_path: Path) -> None:
    config = load(None, DRIFTS)
    folder = open_folder(tmp_path, config)
    with VirtualSession(config) as session:
        list(measure_all(folder, SQUARES, session, 30.0))
    for point, truth in zip(SQUARES, (20.57e-3, 25.74e-3, 23.83e-3), strict=True):
        result = folder.results[folder.key(point)]
        assert result.thrust is not None
        assert result.thrust_ci95 is not None
        assert result.thrust == pytest.approx(truth, abs=2.0 * result.thrust_ci95)
        assert result.thrust_ci95 < 1.5e-3
    recordings = sorted((tmp_path / "ticks").glob("*.mcap"))
    for path in recordings:
        run = open_run(path)
        assert abs(len(run.ticks) - 600) <= 2
        assert all(part.from_start and part.equal == part.ticks for part in rerun(run).stretches)


class TakenSession(VirtualSession):
    """Session in which another client takes the fish at 2 Hz."""

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        if parameters["frequency"] == 2.0:
            raise Disturbed("the fish was to swim square, but sine swims")
        return super().swim(controller, parameters, seconds)


def test_a_fish_that_somebody_else_takes_loses_one_point_only(tmp_path: Path) -> None:
    with pytest.raises(Disturbed):
        measure(open_folder(tmp_path), SQUARES, TakenSession(Config()))
    assert len(open_folder(tmp_path).results) == 2


def test_a_point_that_is_refused_is_trouble_and_the_next_is_measured(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="the extra 'policy' is not installed")
    points = [
        Point("square", {"frequency": 50.0}),
        Point("ppo", {"policy": str(write(tmp_path))}),
        Point("hold", {}),
        Point("square", {"frequency": 1.5}),
    ]
    columns = ["controller", "parameters.frequency", "parameters.policy"]
    folder = open_folder(tmp_path / "sweep", columns=columns)
    measure(folder, points, VirtualSession(Config()))
    kept = open_folder(tmp_path / "sweep", columns=columns).results
    troubles = [kept[folder.key(point)].failure for point in points]
    assert "frequency" in troubles[0]
    assert "ppo gave up" in troubles[1]
    assert troubles[2:] == ["", ""]
    assert len(list((tmp_path / "sweep" / "ticks").glob("*.mcap"))) == 4


@pytest.mark.parametrize(
    ("head", "named"),
    [
        ("controller,parameters.frequency,thrust,thrust_ci95,recording", "has no column beat_freq"),
        (f"controller,parameters.C,{','.join(MEASURED)},recording", "no column parameters.freq"),
    ],
)
def test_a_table_with_other_columns_is_refused_with_what_differs(
    tmp_path: Path, head: str, named: str
) -> None:
    open_folder(tmp_path)
    (tmp_path / "rows.csv").write_text(head + "\n")
    with pytest.raises(ConfigError, match=named):
        open_folder(tmp_path)


def test_a_table_as_long_as_that_of_as_many_points_as_are_permitted_is_resumed(
    tmp_path: Path,
) -> None:
    third = 1.0 / 3.0
    values = ",".join([str(third)] * len(MEASURED))
    longest = f"square,{third + MAX_POINTS},{values},ticks/{MAX_POINTS}-square.mcap\n"
    rows, width = 300, MAX_POINTS * len(longest) // 300  # few rows of this size take no time
    open_folder(tmp_path)
    with (tmp_path / "rows.csv").open("a", encoding="utf-8") as file:
        for k in range(rows):
            file.write(
                f"square,{third + k},{values},ticks/{k}-square.mcap".ljust(width, "x") + "\n"
            )
    assert len(open_folder(tmp_path).results) == rows


def test_a_table_that_cannot_be_written_says_that_the_points_before_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(ENOSPC, "No space left on device", "rows.csv")

    folder = open_folder(tmp_path)
    monkeypatch.setattr("fishd.lab.tables.Table.add", full)
    with pytest.raises(FishdError, match="No space left on device; earlier results are k"):
        folder.add_result(SQUARES[0], Result(), b"a recording")


def test_a_table_that_cannot_be_read_says_why(tmp_path: Path) -> None:
    open_folder(tmp_path)
    (tmp_path / "rows.csv").unlink()
    (tmp_path / "rows.csv").mkdir()
    with pytest.raises(ConfigError, match="is a folder; a regular file is needed"):
        open_folder(tmp_path)


def test_a_point_without_space_for_its_recording_names_no_file_that_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(ENOSPC, "No space left on device")

    task = Task(SQUARES[0], load(), Lengths(1.0, 2), FileStop(tmp_path / "stop"))
    with monkeypatch.context() as disk:
        disk.setattr("fishd.recording.part_file.os.write", full)
        with pytest.raises(RecordingError) as ended:
            simulate_point(task)
    assert str(ended.value).endswith(
        "point.mcap.part: cannot be written: No space left on device; free some space"
    )
    monkeypatch.setattr("tempfile.mkdtemp", full)
    with pytest.raises(FishdError, match="free some space in /tmp, or set TMPDIR"):
        simulate_point(task)


def test_a_curve_tells_the_best_frequency_in_ticks_or_that_it_lacks_one(tmp_path: Path) -> None:
    folder = open_folder(tmp_path)
    thrusts = {1.4: 0.0227, 1.6: 0.0251, 1.8: 0.0252, 2.0: 0.0238, 2.2: 0.0216, 2.5: 0.0176}
    points = [Point("square", {"frequency": value}) for value in thrusts]
    for point, thrust in zip(points, thrusts.values(), strict=True):
        folder.add_result(point, Result(thrust=thrust, thrust_ci95=1e-4), b"a recording")
    (curve,) = make_curves(folder, points)
    whole_ticks = find_best_of_whole_ticks(folder, curve)
    assert whole_ticks == WholeTicks(2.0, 0.0238, 1e-4, pytest.approx(10 / 6))
    best = Point("square", {"frequency": 1.66667})
    folder.add_result(best, Result(thrust=0.02574, thrust_ci95=1e-4), b"a recording")
    (curve,) = make_curves(folder, [*points, best])
    assert find_best_of_whole_ticks(folder, curve) == WholeTicks(1.66667, 0.02574, 1e-4, None)


@pytest.mark.parametrize(("word", "shown"), [("auto", "auto"), (None, "default")])
def test_a_value_that_is_no_number_is_a_line_of_its_own_beside_the_curve(
    tmp_path: Path, word: str | None, shown: str
) -> None:
    folder = open_folder(tmp_path, columns=["controller", "parameters.C"])
    points = [Point("swing", {"C": value}) for value in (word, 0.3, 0.6)]
    for point in points:
        folder.add_result(point, Result(thrust=0.02, thrust_ci95=1e-4), b"a recording")
    shapes = [(curve.label, curve.x_name, curve.x) for curve in make_curves(folder, points)]
    assert shapes == [(f"swing C={shown}", "", []), ("swing", "C", [0.3, 0.6])]


@pytest.mark.parametrize(
    "words",
    [
        ["simulate", "swing", "--seconds", "20"],
        ["optimum"],
        ["sweep", "square", "--frequency", "1.8,2", "--periods", "3", "--jobs", "1"],
    ],
)
def test_a_fin_that_swings_further_than_the_equations_hold_is_told(
    words: Sequence[str], tmp_path: Path
) -> None:
    folder = ["--folder", str(tmp_path / "run")] if words[0] == "sweep" else []
    done = fishctl(*words, "--set", "plant.xi=0.05", *folder)
    assert done.returncode == 0
    assert done.stderr.count("\n") == 1
    assert "beyond 1 rad the equations of the fish do not hold" in done.stderr


@pytest.fixture(scope="module")
def _no_worker_stays() -> Iterator[None]:
    from joblib.externals.loky import get_reusable_executor

    yield
    get_reusable_executor(reuse=True).shutdown(kill_workers=True)


@pytest.mark.slow
@pytest.mark.usefixtures("_no_worker_stays")
def test_a_sweep_is_a_table_recordings_and_a_picture_and_grows(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = ["sweep", "square,sine", "--periods", "3", "--settle", "1", "--folder", str(folder)]
    words += ["--vary", "plant.xi=0.9,1.2", "--jobs", "2"]
    first = fishctl(*words, "--frequency", "1.4:2:0.2")
    assert (first.returncode, first.stderr) == (0, "")
    assert "sine plant.xi=1.2: best measured at frequency" in first.stdout, (
        "four points are too few"
    )
    second = fishctl("sweep", "--resume", str(folder), "--frequency", "1.2:2:0.2", "--json")
    assert second.returncode == 0
    assert "20 points, 16 of them measured already" in second.stderr
    best = msgspec.json.decode(second.stdout)
    assert [(curve["controller"], curve["keys"]) for curve in best] == [
        (name, {"plant.xi": xi}) for xi in (0.9, 1.2) for name in ("square", "sine")
    ]
    assert all(curve["x_ci95_low"] < curve["x"] < curve["x_ci95_high"] for curve in best)
    assert all(curve["parameters"]["frequency"] == curve["x"] for curve in best)
    assert msgspec.json.decode((folder / "result.json").read_bytes()) == best
    assert all(curve["measured"]["x"] in (1.2, 1.4, 1.6, 1.8, 2.0) for curve in best)
    with (folder / "rows.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["parameters.frequency"] for row in rows[:5]] == ["1.2", "1.4", "1.6", "1.8", "2.0"]
    assert all((folder / row["recording"]).is_file() for row in rows)
    assert (folder / "thrust.png").stat().st_size > 10_000
    assert (folder / "thrust.svg").stat().st_size > 10_000


def run_sweep(folder: Path, *words: str) -> CompletedProcess[str]:
    brief = ("--periods", "3", "--settle", "1", "--jobs", "1", "--folder", str(folder))
    return fishctl("sweep", words[0], *brief, *words[1:])


@pytest.mark.usefixtures("_no_worker_stays")
def test_points_without_an_axis_are_a_line_each(tmp_path: Path) -> None:
    single = run_sweep(tmp_path / "one", "swing")
    assert (single.returncode, single.stderr) == (0, "")
    assert "\nswing: 25.7" in single.stdout
    assert not (tmp_path / "one" / "thrust.png").exists()
    pair = run_sweep(tmp_path / "two", "square,sine", "--frequency", "1.7", "--json")
    best = msgspec.json.decode(pair.stdout)
    assert [(curve["controller"], curve["x_name"], curve["x"]) for curve in best] == [
        ("square", "", None),
        ("sine", "", None),
    ]
    assert best[0]["thrust"] > best[1]["thrust"] > 16e-3


@pytest.mark.usefixtures("_no_worker_stays")
def test_a_curve_over_a_key_of_the_configuration_is_drawn(tmp_path: Path) -> None:
    vary = ("--vary", "plant.servo_speed=8,10,12", "--amplitude", "0.3")
    done = run_sweep(tmp_path / "run", "square", "--frequency", "1.7", *vary)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\nsquare: largest at plant.servo_speed 12: " in done.stdout
    assert (tmp_path / "run" / "thrust.png").stat().st_size > 10_000


@pytest.mark.usefixtures("_no_worker_stays")
def test_a_word_among_the_numbers_is_swept_with_them(tmp_path: Path) -> None:
    done = run_sweep(tmp_path / "run", "swing", "--amplitude", "default,0.2,0.4")
    assert (done.returncode, done.stderr) == (0, "")
    assert "\nswing amplitude=default: 25.7" in done.stdout
    assert "\nswing: best measured at amplitude 0.4 rad, " in done.stdout
    assert (tmp_path / "run" / "thrust.png").stat().st_size > 10_000


@pytest.mark.usefixtures("_no_worker_stays")
def test_a_sweep_without_a_single_thrust_says_why_and_draws_nothing(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="the extra 'policy' is not installed")
    from rigs.policy_files import write

    done = run_sweep(tmp_path / "run", "ppo", "--policy", str(write(tmp_path)), "--settle", "15")
    assert done.returncode == 1
    assert "no thrust: ppo gave up" in done.stdout
    assert done.stdout.endswith("rows.csv\n")


@pytest.mark.parametrize("verb", [("sweep", "square"), ("optimise", "square", "--frequency=:")])
def test_what_cannot_be_drawn_here_is_told_before_anything_swims(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: Sequence[str]
) -> None:
    monkeypatch.setattr("fishd.lab.drawing.find_spec", lambda _: None)
    folder = tmp_path / "run"
    assert "[lab]" in one_line(fishctl(*verb, "--folder", str(folder)))
    assert not folder.exists()


@pytest.mark.usefixtures("_no_worker_stays")
def test_what_is_best_is_printed_though_its_picture_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise FishdError("thrust.png: the figure cannot be written: No space left on device")

    monkeypatch.setattr("fishd.lab.sweep.figure.draw", full)
    done = run_sweep(tmp_path / "run", "square", "--frequency", "1.5,1.7,1.9")
    assert "\nsquare: best measured at frequency 1.7" in done.stdout
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "No space left" in done.stderr


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--frequency", "1:2"], "LOW:HIGH:STEP"),
        (["--frequency", "1,20"], "frequency"),
        (["--frequency", "1,4", "--vary", "tick=0.05,0.2"], "2.5 Hz is possible (with tick=0.2 s)"),
        (["--amplitude", "0.3,0.6"], "amplitude_limit"),
        (["--vary", "plant.xj=1,2"], "--vary plant.xj=1"),
        (["--vary", "plant.xi"], "write KEY=VALUES"),
        (["--for", "30", "--on", "simulation"], "is for --on live"),
        (["--on", "live", "--vary", "plant.xi=1,2"], "is for --on simulation"),
        (["--on", "live", "--for", "5"], "not possible"),
    ],
)
def test_what_cannot_be_swept_is_one_line_before_anything_is_made(
    tmp_path: Path, words: Sequence[str], named: str
) -> None:
    folder = tmp_path / "run"
    assert named in one_line(fishctl("sweep", "square", *words, "--folder", str(folder)))
    assert not folder.exists()
