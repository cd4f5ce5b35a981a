"""`fishctl optimum`: output for the configured fish, and refusals."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from fishd.cli.main import fishctl
from fishd.core.errors import FishdError

QUICK_SERVO = ("--set", "plant.servo_speed=1000", "--set", "plant.servo_lag=0.001")
"""Options for a servo whose best command is computed fast."""


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(fishctl, ["optimum", *arguments])


def test_it_shows_the_best_square_wave_and_the_limits_of_the_configured_fish() -> None:
    done = invoke("--amplitude", "0.31", "--amplitude", "0.42")
    assert done.exit_code == 0
    assert "best square 15.366 mN at 1.753 Hz" in done.output
    assert "best square 25.784 mN at 1.709 Hz" in done.output
    assert "slow servo  91.825 mN" in done.output
    results = json.loads(invoke("--set", "plant.servo_speed=11.6", "--json").output)
    assert results["saturation_amplitude"] == pytest.approx(11.6 / 12.5)
    assert results["best_square"]["amplitude"] == [0.42]


@pytest.mark.slow
def test_optimal_control_is_printed_and_drawn(tmp_path: Path) -> None:
    picture = tmp_path / "best.svg"
    done = invoke("--any-shape", "--plot", str(picture), *QUICK_SERVO)
    assert done.exit_code == 0
    assert "|φ_c| = Φ in 100.0% of the time" in done.output
    assert picture.read_text(encoding="utf-8").startswith("<?xml")


@pytest.mark.parametrize(
    ("file", "complaint"),
    [
        ("missing/best.png", "does not exist"),
        ("best.xyz", "a figure has no format .xyz: .pdf, .png"),
    ],
)
def test_a_figure_that_cannot_be_written_is_refused_before_anything_is_computed(
    file: str, complaint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fishd.lab.optimum.optimal_control", lambda *_: pytest.fail("computed"))
    done = invoke("--any-shape", "--plot", str(tmp_path / file))
    assert isinstance(done.exception, FishdError)
    assert complaint in str(done.exception)


def test_ignored_parameters_are_reported() -> None:
    done = invoke("--set", "plant.backlash=0.02")
    assert "the limits leave out plant.backlash" in done.stderr


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("--plot best.png", "give both"),
        ("--any-shape --amplitude 0.2 --amplitude 0.3", "one --amplitude at a time"),
        *(
            (f"--amplitude {value}", "a number in (0, 1.57] is needed")
            for value in ("0", "-0.1", "1.6", "nan", "inf")
        ),
    ],
)
def test_what_has_no_sense_is_refused(line: str, complaint: str) -> None:
    done = invoke(*line.split())
    assert done.exit_code == 2
    assert complaint in done.output
