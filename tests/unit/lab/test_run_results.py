"""Results of runs side by side: of recordings, and of each kind of experiment."""

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.harness import Rig
from rigs.processes import fishctl, one_line
from rigs.recordings import record_run

from fishd.lab.experiment import Header, open_experiment
from fishd.lab.run_results import read_results


def write_experiment(path: Path, kind: str, result: Any, rows: list[dict[str, Any]] = []) -> Path:  # noqa: B006
    """Write the folder of a finished experiment with this result and these rows."""
    with open_experiment(path, Header(kind=kind, on="simulation")) as experiment:
        if rows:
            table = experiment.open_table(list(rows[0]))
            for row in rows:
                table.add(row)
        if result is not None:
            experiment.write_result(result)
    return path


GAIT = {
    "controller": "swing", "contestant": "swing:C=0.6", "parameters": {"C": 0.6}, "thrust": 0.025,
    "thrust_ci95": 0.001, "total_ci95": 0.002, "frequency": 1.7, "power": 0.6, "power_ci95": 0.01,
    "thrust_per_watt": 0.04, "thrust_per_watt_ci95": 0.001, "thrust_per_watt_total_ci95": 0.003,
}  # fmt: skip
ESTIMATES = {
    "xi": {"value": 1.2, "ci95_low": 1.1, "ci95_high": None, "unit": "1/s"},
    "backlash": {"value": 0.0, "ci95_low": 0.0, "ci95_high": 0.0, "unit": "rad", "fitted": False},
}
OPTIMUM = {
    **GAIT, "contestant": None, "parameters": {"C": 0.612345, "lead": None},
    "parameters_ci95_low": {"C": 0.5}, "parameters_ci95_high": {"C": 0.7},
}  # fmt: skip
BEST = {
    "controller": "square", "parameters": {"frequency": 1.7}, "x_name": "frequency", "x": 1.7,
    "x_ci95_low": 1.6, "x_ci95_high": 1.8, "thrust": 0.025, "thrust_ci95": None,
}  # fmt: skip
ADAPTED = {
    "gaits": [GAIT, {**GAIT, "contestant": "square", "thrust": 0.02}],
    "fitted": {"identification": {"estimates": ESTIMATES}}, "verdict": "swing wins",
    "thrust": 0.025, "thrust_ci95": 0.001, "summary": "chosen: swing --C 0.6",
}  # fmt: skip
XI = ("xi", 1.2, 1.1, None, "1/s")


@pytest.mark.parametrize(
    ("kind", "result", "labels", "estimates", "summary"),
    [
        ("measure", {**GAIT, "contestant": None}, ["swing:C=0.6"], [], ""),
        ("compare", [GAIT, {**GAIT, "contestant": "x"}], ["swing:C=0.6", "x"], [], ""),
        ("optimise", OPTIMUM, ["swing:C=0.6123"], [("C", 0.612345, 0.5, 0.7, "1")], ""),
        ("sweep", [BEST], ["square:frequency=1.7"], [("frequency", 1.7, 1.6, 1.8, "Hz")], ""),
        ("identify", {"estimates": ESTIMATES, "headline": "identified"}, [], [XI], "identified"),
        ("adapt", ADAPTED, ["swing:C=0.6", "square"], [XI], "swing wins"),
        ("learn ppo", {"thrust": 0.02, "thrust_ci95": 0.0, "summary": "99 %"}, [""], [], "99 %"),
        ("sweep", None, [], [], ""),
    ],
)
def test_each_experiment_states_its_answer(
    tmp_path: Path, kind: str, result: Any, labels: list[str], estimates: Any, summary: str
) -> None:
    results = read_results(write_experiment(tmp_path / "run", kind, result))
    assert [row.label for row in results.rows] == labels
    assert results.estimates == estimates
    assert (results.kind, results.summary) == (kind, summary)
    for row in results.rows[:1]:
        thrust, ci95 = row.values["thrust"]
        source = result[0] if isinstance(result, list) else result.get("gaits", [result])[0]
        assert thrust == source["thrust"]
        assert ci95 == source.get("total_ci95", source["thrust_ci95"])
        if "thrust_per_watt" in source:
            assert row.values["thrust_per_watt"] == (0.04, 0.003)
            assert row.values["frequency"] == (1.7, None)


def test_the_rows_of_an_experiment_are_columns_of_numbers(tmp_path: Path) -> None:
    rows = [
        {"controller": "square", "frequency": 1.0, "thrust": 0.02, "failure": ""},
        {"controller": "sine", "frequency": "auto", "thrust": "", "failure": "slack"},
    ]
    results = read_results(write_experiment(tmp_path / "run", "sweep", [], rows))
    assert results.columns == {"frequency": [1.0, None], "thrust": [0.02, None]}
    assert results.labels == ["square", "sine"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with recordings of two frequencies, known zero, and of a fish at rest."""
    folder = tmp_path_factory.mktemp("runs")
    for name, frequency in (("slow", 1.0), ("fast", 2.0)):
        rig = Rig()
        rig.run_for(10)
        rig.start("square", frequency=frequency)
        rig.run_for(12)
        record_run(rig, folder / name)
    resting = Rig()
    resting.run_for(2)
    record_run(resting, folder / "resting")
    return folder


def test_a_recording_has_thrust_frequency_and_efficiency_with_their_intervals(
    recordings: Path,
) -> None:
    for name, frequency in (("slow", 1.0), ("fast", 2.0)):
        (row,) = read_results(recordings / f"{name}.mcap").rows
        assert row.label == "square"
        mean, ci95 = row.values["frequency"]
        assert ci95 is not None
        assert mean == pytest.approx(frequency, abs=0.02 + ci95)
        for quantity in ("thrust", "power", "thrust_per_watt"):
            value, half_width = row.values[quantity]
            assert half_width is not None
            assert 0.0 < half_width < value
        thrust, power, ratio = (row.values[q][0] for q in ("thrust", "power", "thrust_per_watt"))
        assert ratio == pytest.approx(thrust / power)
    (resting,) = read_results(recordings / "resting.mcap").rows
    assert (resting.label, resting.values) == ("at rest", {})


def test_runs_are_shown_side_by_side(recordings: Path) -> None:
    write_experiment(recordings / "best", "optimise", OPTIMUM)
    volts = {**GAIT, "thrust": 1.0, "total_ci95": None, "thrust_ci95": None}
    with open_experiment(
        recordings / "volts", Header(kind="measure", on="live", force_unit="V")
    ) as experiment:
        experiment.write_result(volts)
    words = ("runs", "show", "slow", "best", "volts", "--folder", str(recordings))
    shown = fishctl(*words)
    assert shown.stderr == ""
    assert "25.00 ± 2.00" in shown.stdout
    assert "1000 ± ? mV" in shown.stdout
    assert "best: C 0.6123 [0.5, 0.7]" in shown.stdout
    results = json.loads(fishctl(*words, "--json").stdout)
    assert [result["name"] for result in results] == ["slow", "best", "volts"]
    damaged = recordings / "best" / "result.json"
    damaged.write_bytes(msgspec.json.encode(3))
    assert f"{damaged}: not a result" in one_line(fishctl(*words))


@pytest.mark.slow  # to load matplotlib takes seconds
def test_several_runs_are_drawn_over_each_other(recordings: Path, tmp_path: Path) -> None:
    words = ("plot", "slow", "fast", "resting", "--folder", str(recordings))
    drawn = fishctl(*words)
    assert drawn.stdout == f"{recordings / 'slow-compared.png'}\n"
    assert (recordings / "slow-compared.png").read_bytes().startswith(b"\x89PNG")
    svg = tmp_path / "both.svg"
    assert fishctl(*words, "--from", "1", "--to", str(svg)).returncode == 0
    assert all(f"<!-- {text} -->" in svg.read_text() for text in ("slow", "fast", "tail beat (Hz)"))
    (tmp_path / "slow.mcap").write_bytes((recordings / "fast.mcap").read_bytes())
    same = ("plot", str(recordings / "slow.mcap"), str(tmp_path / "slow.mcap"), "--force")
    assert fishctl(*same, "--to", str(svg)).returncode == 0
    assert svg.read_text().count("<!-- slow -->") == 2, "runs of one name in two folders"
    empty = write_experiment(tmp_path / "empty", "sweep", [])
    drawn = fishctl(*words, str(empty), "--to", str(svg), "--force")
    assert drawn.returncode == 0
    assert "no recording: empty" in svg.read_text()
    refused = one_line(fishctl("plot", str(empty), str(empty), "--to", str(svg), "--force"))
    assert "nothing can be drawn: no recording in empty" in refused
