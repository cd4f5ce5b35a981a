"""Experiments that are only planned, and the progress of those that run for a page."""

from pathlib import Path

import msgspec
import pytest
from rigs.processes import fishctl, one_line

from fishd.core.experiments import PROGRESS_PREFIX, PROGRESS_VARIABLE, Plan, Progress

SIMULATED = ("--on", "simulation", "--dry-run", "--json")


@pytest.fixture(autouse=True)
def _in_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("words", "plan"),
    [
        (("measure", "square", "--for", "30"), Plan(30.0, "s")),
        (
            ("sweep", "square", "--frequency", "1:2:0.5", "--amplitude", "0.2,0.3"),
            Plan(6, "points"),
        ),
        (("compare", "square", "--for", "20", "--settle", "2"), Plan(20.0, "s swum")),
        (("identify", "--experiment", "--for", "40"), Plan(40.0, "s")),
        (("learn", "ppo", "--steps", "70"), Plan(128, "steps")),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_a_dry_run_tells_the_length_of_an_experiment_and_writes_nothing(
    words: tuple[str, ...], plan: Plan, tmp_path: Path
) -> None:
    done = fishctl(*words, *SIMULATED)
    assert (done.returncode, done.stderr) == (0, "")
    assert msgspec.json.decode(done.stdout, type=Plan) == plan
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("measure", "square", "--for", "3"), "20.25 to 3600 s are needed"),
        (("sweep", "square", "--frequency", "99"), "frequency"),
        (("optimise", "square", "--frequency", ":", "--budget", "5"), "one candidate takes"),
        (("identify", "--experiment", "--fit", "nothing"), "nothing"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_a_dry_run_refuses_what_the_experiment_would_refuse(
    words: tuple[str, ...], message: str
) -> None:
    assert message in one_line(fishctl(*words, *SIMULATED))


def test_an_experiment_to_be_resumed_has_no_dry_run() -> None:
    words = ("measure", "square", "--folder", "one", "--on", "simulation", "--for", "21")
    assert fishctl(*words).returncode == 0
    done = fishctl("measure", "--resume", "one", "--dry-run")
    assert "--dry-run is for a new experiment" in done.stderr


def test_an_option_for_the_other_kind_of_fish_is_refused() -> None:
    done = fishctl("sweep", "square", "--frequency", "1", "--for", "30", *SIMULATED)
    assert "--for is for --on live" in done.stderr


def test_the_progress_of_an_experiment_is_lines_of_json_for_a_page_and_none_for_a_person(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = ("measure", "square", "--on", "simulation", "--for", "60", "--json")
    prefix = PROGRESS_PREFIX.decode()
    assert prefix not in fishctl(*words).stderr
    monkeypatch.setenv(PROGRESS_VARIABLE, "json")
    done = fishctl(*words)
    lines = [line for line in done.stderr.splitlines() if line.startswith(prefix)]
    reports = [msgspec.convert(msgspec.json.decode(x)["progress"], Progress) for x in lines]
    shares = [report.fraction for report in reports]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    points = [report.point for report in reports if report.point]
    assert [point.x for point in points] == list(range(1, len(points) + 1))
    (last,) = reports[-1].estimates or ()
    assert last.value == msgspec.json.decode(done.stdout)["thrust"]
