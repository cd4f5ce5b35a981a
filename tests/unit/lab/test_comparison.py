"""Comparison of policies and controllers on the same fish: results and picture."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rigs.harness import PINNED_TICK
from rigs.pictures import letters_of, texts_in_pictures
from rigs.policy_files import write

from fishd.config import load
from fishd.core.errors import ParameterError, UnknownController
from fishd.lab.compare import comparison
from fishd.lab.compare.comparison import Standing, Trace, compare, judge_standings
from fishd.lab.compare.contestants import default_contestants, parse

CONFIG = load(None, [PINNED_TICK, "simulation.offset_y=0.005"])
FIGURES = "install the extra 'lab'"


def compare_texts(*texts: str, runs: int = 1) -> list[comparison.Standing]:
    return compare(CONFIG, [parse(text) for text in texts], 20.0, 5.0, runs)[0]


def test_square_beats_sine_beats_triangle_and_each_is_as_square_as_it_is() -> None:
    standings = compare_texts(*(f"{name}:frequency=1.7" for name in ("square", "sine", "triangle")))
    relative_thrusts = [standing.relative_thrust for standing in standings]
    assert relative_thrusts == sorted(relative_thrusts, reverse=True)
    factors = [standing.form_factor for standing in standings]
    assert factors == pytest.approx([1.0, 0.900, 0.866], abs=0.003)
    fullness = [standing.fullness for standing in standings]
    assert fullness == pytest.approx([1.0, 0.637, 0.5], abs=0.01)
    assert standings[0].frequency == pytest.approx(1.7, abs=0.02)


def test_the_runs_of_a_contestant_differ_in_noise_and_give_the_interval_of_their_mean() -> None:
    config = load(None, [PINNED_TICK, "simulation.noise=0.02"])
    (standing,), _ = compare(config, ["swing"], 20.0, 5.0, runs=5)
    thrusts = np.array(standing.thrusts)
    assert len(set(thrusts)) > 1
    assert standing.thrust == pytest.approx(thrusts.mean())
    # Student's t of four degrees of freedom, from a table.
    assert standing.thrust_ci95 == pytest.approx(2.776 * thrusts.std(ddof=1) / 5**0.5, rel=1e-3)
    assert compare(config, ["swing"], 20.0, 5.0)[0][0].thrust_ci95 is None


def test_it_is_said_that_another_controller_took_over_from_a_policy(tmp_path: Path) -> None:
    shaking = parse(str(write(tmp_path)))
    (policy, swing), _ = compare(load(None, [PINNED_TICK]), [shaking, parse("swing")], 20.0, 5.0)
    assert "it wanted to reverse sooner than 0.2 s after its last reversal" in policy.fallbacks[0]
    assert (policy.faults, swing.fallbacks) == ([], [])


def standing(contestant: str, controller: str, thrusts: list[float], **given: Any) -> Standing:
    return Standing(
        contestant=contestant, controller=controller, parameters={}, thrust=float(np.mean(thrusts)),
        thrust_ci95=comparison.mean_ci95(thrusts), frequency=1.7, fullness=1.0, form_factor=1.0,
        thrusts=thrusts, **given,
    )  # fmt: skip


def test_a_verdict_names_a_winner_where_the_runs_tell_and_else_chooses_the_simplest() -> None:
    swing = standing("swing", "swing", [20.0e-3, 20.2e-3, 20.1e-3])
    square = standing("a wave", "square", [20.0e-3, 20.1e-3, 20.0e-3])
    slow = standing("slow", "square", [15.0e-3, 15.1e-3, 15.0e-3])
    undecided = judge_standings([swing, slow, square])
    assert undecided
    assert undecided.best == ("a wave", "swing")
    sentence = "undecided between a wave and swing; a wave is chosen because it is the simplest"
    assert undecided.sentence == sentence
    decided = judge_standings([slow, swing])
    assert decided
    assert decided.sentence.startswith("swing wins: it thrusts 133.")
    assert decided.sentence.endswith(" of slow, the next one")
    failed = standing("policy", "ppo", [30e-3] * 3, fallbacks=["swing took over"])
    assert judge_standings([failed, slow, swing]) == decided
    assert judge_standings([failed, swing]) is None


def test_a_single_run_is_exact_without_noise_and_has_no_verdict_with_it() -> None:
    swing, square = standing("swing", "swing", [21e-3]), standing("square", "square", [20e-3])
    exact = judge_standings([swing, square], is_random=False)
    noisy = judge_standings([swing, square])
    assert exact
    assert noisy
    assert "swing wins: it thrusts exactly 105.0 % of square" in exact.sentence
    assert noisy == ("none: a single run with noise has no interval; use --runs 5", ())
    waves = judge_standings([square, standing("sine", "sine", [17e-3])])
    assert waves
    assert waves.best == ("square",)


def test_what_the_fish_starts_with_takes_no_part() -> None:
    config = load(None, [PINNED_TICK, "start.controller=hold"])
    (standing,), _ = compare(config, [parse("swing")], 20.0, 5.0)
    assert standing.relative_thrust > 0.9


def test_without_names_the_best_square_wave_of_whole_ticks_meets_swing() -> None:
    square, swing, *_ = default_contestants(CONFIG)
    assert square.parameters["frequency"] == pytest.approx(1 / 0.6)
    assert (square.controller, swing.controller) == ("square", "swing")


def test_what_is_no_controller_is_taken_for_a_policy() -> None:
    assert parse("default-fish") == ("default-fish", "ppo", {"policy": "default-fish"})
    assert parse("C:/a.onnx").parameters == {"policy": "C:/a.onnx"}
    for text, hint in (("sqare:frequency=2", "square"), ("defaultfish", "default-fish")):
        with pytest.raises(ParameterError, match=f"is not a controller, named .* '{hint}'"):
            parse(text)


def test_none_swims_before_all_are_known_to_be_able_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "judge", lambda *_: pytest.fail("a contestant swam"))
    with pytest.raises(ParameterError, match="frequency"):
        compare_texts("swing", "square:frequency=99")


@pytest.mark.parametrize(
    "text", ["swing:C", "swing:=1", "swing:C=", "swing:C=[", "swing:D=1", "swing:C=much"]
)
def test_a_contestant_that_is_spelled_wrong_is_refused_in_one_line(text: str) -> None:
    with pytest.raises((ParameterError, UnknownController)) as caught:
        compare_texts(text)
    assert "\n" not in str(caught.value)
    assert "swing" in str(caught.value)


def test_a_trace_is_the_end_of_the_run() -> None:
    _, (trace,) = compare(CONFIG, [parse("square:frequency=1")], 20.0, 5.0)
    assert trace.time[-1] == 0.0
    assert trace.time[0] <= -comparison.TRACE_S
    assert set(trace.command) == {0.42, -0.42}
    assert max(trace.thrust) > 0.02
    assert 0.1 < max(trace.fin) < 0.4


def test_the_picture_begins_with_an_upward_reversal() -> None:
    figures = pytest.importorskip("fishd.lab.compare.figures", reason=FIGURES)
    times = [0.05 * k - 5.0 for k in range(101)]
    command = [0.4 if k % 20 >= 10 else -0.4 for k in range(101)]
    shown = figures._from_upward_reversal(Trace(times, command, times, times))
    assert (shown.time[0], shown.command[0]) == (0.0, 0.4)
    assert shown.time[-1] == pytest.approx(comparison.TRACE_S)


@pytest.mark.slow
def test_the_picture_names_each_line_bar_and_whisker_and_the_amplitude(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason=FIGURES)
    from fishd.lab.compare.figures import draw

    contestants = [parse("swing"), parse("sine:frequency=1.8")]
    with texts_in_pictures():
        for runs in (1, 3):
            standings, traces = compare(CONFIG, contestants, 20.0, 5.0, runs)
            draw(tmp_path / f"{runs}.svg", standings, traces, 0.42)
    single, triple = letters_of(tmp_path / "1.svg"), letters_of(tmp_path / "3.svg")
    for name in ("command", "finangle", "asmeasured", "truemean", "relativethrust", "Φ=0.42rad"):
        assert name in single
        assert name in triple
    assert "lowesttohighestof3runs" in triple
    assert "lowest" not in single


def test_the_command_is_not_drawn_beyond_the_time_that_is_shown() -> None:
    pytest.importorskip("matplotlib", reason=FIGURES)
    from matplotlib.figure import Figure

    from fishd.lab.compare.figures import _draw_angles

    axis = Figure().subplots()
    _draw_angles(axis, Trace([0.0, 0.05, 0.1], [0.4, 0.4, -0.4], [0.0] * 3, [0.0] * 3), 0.42)
    (command,) = axis.patches
    assert list(command.get_data().values) == [0.4, 0.4]
    assert list(command.get_data().edges) == [0.0, 0.05, 0.1]
