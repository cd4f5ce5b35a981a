"""Policies and controllers on the same fish: a table, JSON and a picture."""

import json
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rigs.processes import fishctl

from fishd.config import load
from fishd.core.errors import FishdError, ParameterError, UnknownController
from fishd.learning.compare import comparison
from fishd.learning.compare.comparison import Trace, compare, parse

CONFIG = load(None, ["simulation.offset_y=0.005"])


def swum(*texts: str, runs: int = 1) -> list[comparison.Standing]:
    return compare(CONFIG, [parse(text) for text in texts], 20.0, 5.0, runs)[0]


def test_square_beats_sine_beats_triangle_and_each_is_as_square_as_it_is() -> None:
    standings = swum(*(f"{name}:frequency=1.7" for name in ("square", "sine", "triangle")))
    efficiencies = [standing.efficiency for standing in standings]
    assert efficiencies == sorted(efficiencies, reverse=True)
    assert [standing.squareness for standing in standings] == pytest.approx(
        [1.0, 0.900, 0.866], abs=0.003
    )
    assert standings[0].frequency == pytest.approx(1.7, abs=0.02)


def test_the_runs_of_a_contestant_differ_in_noise_and_are_summarised_by_the_median() -> None:
    config = load(None, ["simulation.noise=0.02"])
    (standing,), _ = compare(config, [parse("swing")], 20.0, 5.0, runs=5)
    found = sorted(run.efficiency for run in standing.runs)
    assert len(set(found)) > 1
    assert [standing.lowest_efficiency, standing.efficiency, standing.highest_efficiency] == [
        found[0],
        found[2],
        found[4],
    ]


def test_it_is_said_that_another_controller_took_over_from_a_policy() -> None:
    config = load(None, ["plant.cable_slack=0.2"])
    (policy, swing), _ = compare(config, [parse("default-fish"), parse("swing")], 20.0, 5.0)
    assert "it wanted to reverse sooner than 0.2 s after its last reversal" in policy.fallbacks[0]
    assert (policy.faults, swing.fallbacks) == ([], [])
    words = ["--seconds", "20", "--set", "plant.cable_slack=0.2"]
    done = run("default-fish", *words)
    assert done.returncode == 0
    assert f"fishctl: default-fish: another took over: {policy.fallbacks[0]}" in done.stderr


def test_what_the_fish_starts_with_takes_no_part() -> None:
    config = load(None, ["start.controller=hold"])
    (standing,), _ = compare(config, [parse("swing")], 20.0, 5.0)
    assert standing.efficiency > 0.9


def test_without_names_the_best_square_wave_of_whole_ticks_meets_swing() -> None:
    square, swing, *_ = comparison.default_contestants(CONFIG)
    assert square.parameters["frequency"] == pytest.approx(1 / 0.6)
    assert (square.controller, swing.controller) == ("square", "swing")


def test_what_is_no_controller_is_taken_for_a_policy() -> None:
    assert parse("default-fish") == ("default-fish", "ppo", {"policy": "default-fish"})
    assert parse("C:/a.onnx").parameters == {"policy": "C:/a.onnx"}
    for text, hint in (("sqare:frequency=2", "square"), ("defaultfish", "default-fish")):
        with pytest.raises(ParameterError, match=f"is not a controller, named .* '{hint}'"):
            parse(text)


def test_nobody_swims_before_everybody_is_known_to_be_able_to(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(comparison, "judge", lambda *_: pytest.fail("somebody swam"))
    with pytest.raises(ParameterError, match="frequency"):
        swum("swing", "square:frequency=99")


@pytest.mark.parametrize(
    "text", ["swing:C", "swing:=1", "swing:C=", "swing:C=[", "swing:D=1", "swing:C=much"]
)
def test_a_contestant_that_is_spelled_wrong_is_refused_in_one_line(text: str) -> None:
    with pytest.raises((ParameterError, UnknownController)) as caught:
        swum(text)
    assert "\n" not in str(caught.value)
    assert "swing" in str(caught.value)


def test_a_trace_is_the_end_of_the_run() -> None:
    _, (trace,) = compare(CONFIG, [parse("square:frequency=1")], 20.0, 5.0)
    assert trace.time[-1] == 0.0
    assert trace.time[0] <= -comparison.TRACE
    assert set(trace.command) == {0.42, -0.42}
    assert max(trace.thrust) > 0.02
    assert 0.1 < max(trace.fin) < 0.4


def test_the_picture_begins_with_an_upward_reversal() -> None:
    figures = pytest.importorskip("fishd.learning.compare.figures")
    times = [0.05 * k - 5.0 for k in range(101)]
    command = [0.4 if k % 20 >= 10 else -0.4 for k in range(101)]
    shown = figures._from_upward_reversal(Trace(times, command, times, times))
    assert (shown.time[0], shown.command[0]) == (0.0, 0.4)
    assert shown.time[-1] == pytest.approx(comparison.TRACE)


def letters_of(picture: Path) -> str:
    """What is written in an SVG picture whose text was kept as text, without any spaces."""
    return "".join("".join(ElementTree.parse(picture).getroot().itertext()).split())


def test_the_picture_names_each_line_bar_and_whisker_and_the_amplitude(tmp_path: Path) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    from fishd.learning.compare.figures import picture

    contestants = [parse("swing"), parse("sine:frequency=1.8")]
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        for runs in (1, 3):
            standings, traces = compare(CONFIG, contestants, 20.0, 5.0, runs)
            picture(tmp_path / f"{runs}.svg", standings, traces, 0.42)
    one, three = letters_of(tmp_path / "1.svg"), letters_of(tmp_path / "3.svg")
    for name in ("command", "finangle", "asmeasured", "truemean", "efficiency", "Φ=0.42rad"):
        assert name in one
        assert name in three
    assert "lowesttohighestof3runs" in three
    assert "lowest" not in one


def test_the_command_is_not_drawn_beyond_the_time_that_is_shown() -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    from fishd.learning.compare.figures import _draw_angles

    axis = Figure().subplots()
    _draw_angles(axis, Trace([0.0, 0.05, 0.1], [0.4, 0.4, -0.4], [0.0] * 3, [0.0] * 3), 0.42)
    (command,) = axis.patches
    assert list(command.get_data().values) == [0.4, 0.4]
    assert list(command.get_data().edges) == [0.0, 0.05, 0.1]


def test_learning_curves_name_their_goal_and_where_the_axis_begins(tmp_path: Path) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    from bench.learning_curves import learning_curves

    curve = [([200, 400], [0.5, 0.98]), ([200, 400], [0.6, 0.99])]
    trainings = {f"training-{k}": curve for k in range(7)}
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        learning_curves(tmp_path / "curves.svg", trainings, 0.97)
    letters = letters_of(tmp_path / "curves.svg")
    assert "97%" in letters
    assert "from60%up" in letters
    assert all(name in letters for name in trainings)


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return fishctl("learn", "evaluate", *arguments)


def test_the_command_draws_a_picture_and_prints_a_table(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    picture = tmp_path / "contest.png"
    done = run("swing:C=0.5", "hold", "--seconds", "15", "--settle", "5", "--png", str(picture))
    assert (done.returncode, done.stderr) == (0, "")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "swing:C=0.5" in done.stdout
    assert max(len(line.rstrip()) for line in done.stdout.splitlines()) <= 80


def test_the_command_prints_json_with_every_run() -> None:
    done = run("swing", "square", "--seconds", "15", "--settle", "5", "--seeds", "2", "--json")
    first, second = json.loads(done.stdout)
    assert (first["contestant"], second["contestant"]) == ("swing", "square")
    assert len(first["runs"]) == 2
    assert {"efficiency", "thrust", "frequency", "fullness", "squareness"} <= set(first)


def test_one_that_is_refused_does_not_keep_the_others_from_swimming() -> None:
    other = ("--set", "amplitude_limit=0.31", "--seconds", "15", "--settle", "5")
    done = run("swing", "default-fish", *other, "--json")
    assert [standing["contestant"] for standing in json.loads(done.stdout)] == ["swing"]
    assert done.stderr.startswith("fishctl: default-fish: refused: ppo: policy: ")
    assert "0.42 rad" in done.stderr
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert run("default-fish", *other).stderr.startswith("fishctl: ppo: policy: ")


def test_a_picture_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from fishd.learning.compare.figures import picture

    standings, traces = compare(CONFIG, [parse("hold")], 6.0, 1.0)
    with pytest.raises(FishdError, match=r"no/such\.png: the picture cannot be written"):
        picture(tmp_path / "no" / "such.png", standings, traces, 0.42)


@pytest.mark.parametrize(
    ("arguments", "message", "status"),
    [
        (["swing:C=2"], "fishctl: swing: C: 2 is not valid: a number in [0, 1]", 1),
        (["swing", "--seconds", "1"], "fishctl: nothing is left to judge", 1),
        (["swing", "--set", "tick=3"], "fishctl: --set tick=3: tick: 3 is not valid", 78),
    ],
)
def test_a_wrong_command_is_one_line(arguments: list[str], message: str, status: int) -> None:
    done = run(*arguments)
    assert message in done.stderr
    assert (done.stdout, done.returncode, done.stderr.count("\n")) == ("", status, 1)
