"""`fishctl identify`: from an experiment to a configuration, a recording and a picture."""

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from fishd.cli.main import fishctl
from fishd.config import load
from fishd.core.errors import ConfigError, FishdError
from fishd.lab.experiment import find_answer


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(fishctl, ("identify", *arguments))


@pytest.mark.slow
def test_an_experiment_becomes_a_configuration_a_recording_and_a_picture(tmp_path: Path) -> None:
    fish, folder, picture = (tmp_path / name for name in ("fish.yaml", "run", "fit.png"))
    record = folder / "identify.mcap"
    swim = ("--experiment", "--for", "40", "--folder", str(folder), "--plot", str(picture))
    done = invoke(*swim, "--set", "plant.omega0=11", "--to", str(fish))
    assert done.exit_code == 0, done.output
    assert "\nidentified: the model explains 9" in done.stdout
    assert "omega0 ω₀" in done.stdout
    assert "if K_y/K = 1" in done.stdout
    assert f"{fish}: written; to swim it: fishctl simulate swing --config {fish}" in done.stdout
    assert load(fish).plant.omega0 == pytest.approx(11.0, rel=0.01)
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert find_answer(folder).summary.startswith("omega0=1")

    words = ("--fit", "omega0, xi, coupling", "--fix", "coupling", "--set", "plant.omega0=11")
    second = invoke(str(record), *words, "--json", "--to", str(fish), "--force")
    assert second.exit_code == 0
    assert f"{fish}: written" in second.stderr
    result = json.loads(second.stdout)
    assert result["origin"] == "identify.mcap"
    estimates = result["estimates"]
    assert estimates["omega0"]["ci95_low"] < 11.0 < estimates["omega0"]["ci95_high"]
    assert not estimates["coupling"]["fitted"]

    refused = invoke(str(record), "--to", str(fish))
    assert isinstance(refused.exception, FishdError)
    assert "exists already; --force overwrites it, --to names another" in str(refused.exception)


def test_a_folder_that_cannot_be_made_is_reported_before_the_fish_swims(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swum: list[object] = []
    monkeypatch.setattr("fishd.lab.identification.estimation", lambda *_: swum.append(1))
    (tmp_path / "file").touch()
    done = invoke("--experiment", "--folder", str(tmp_path / "file/run"))
    assert isinstance(done.exception, ConfigError)
    assert "file/run: the folder cannot be created: Not a directory" in str(done.exception)
    assert swum == []


def test_a_run_is_a_name_or_the_latest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "first"
    monkeypatch.setenv("FISHD_RUNS", str(folder))
    known = ("--fit", "omega0", "--set", "simulation.rotation=0.1")
    swim = ("--experiment", "--for", "30", "--folder", str(folder), *known)
    assert invoke(*swim).exit_code == 0
    results = [invoke(run, *known) for run in ("identify", "identify.mcap", "latest")]
    assert results[0].stdout.endswith("\nfrom identify.mcap\n")
    assert {result.stdout for result in results} == {results[0].stdout}
    # No warning: the model includes the turned sensor
    assert {result.stderr for result in results} == {""}
    assert "the folder is not empty" in str(invoke(*swim).exception)


@pytest.mark.parametrize(
    ("words", "fish"),
    [
        ((), "the default simulated fish"),
        (("--set", "plant.xi=1"), "the default simulated fish, changed by --set"),
        (("--config", "fish.yaml"), "the simulated fish of fish.yaml"),
    ],
)
def test_it_says_which_fish_swam(
    words: tuple[str, ...], fish: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("fish.yaml").write_text("plant:\n  omega0: 11\n", encoding="utf-8")
    done = invoke("--experiment", "--for", "30", "--fit", "omega0", *words)
    assert done.stdout.startswith(f"fish: {fish}\n")
    assert done.stdout.endswith(f"\nfrom an experiment with {fish}\n")


def test_a_drift_is_reported_in_both_directions() -> None:
    drifting = ("--set", "simulation.drift=0.01")
    done = invoke("--experiment", "--for", "70", "--fit", "omega0", *drifting)
    shown = [float(drift) for drift in re.findall(r"drift ±(\S+) mN", done.stdout)]
    assert shown == [pytest.approx(10.0, abs=0.5)] * 2


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ((), "name recordings to identify, or use --experiment: one of the two"),
        (("run.mcap", "--for", "60"), "--for goes with --experiment"),
        (("run.mcap", "--folder", "x"), "--folder goes with --experiment"),
        (("--experiment", "--for", "5"), "5.0 is not in the range"),
        (("--experiment", "--for", "nan"), "'nan' is not valid: a finite number is needed"),
    ],
)
def test_a_command_line_without_sense_is_refused(words: tuple[str, ...], complaint: str) -> None:
    done = invoke(*words)
    assert done.exit_code == 2
    assert complaint in done.stderr


@pytest.mark.parametrize(
    ("words", "complaint"),
    [(("no.mcap",), "no.mcap"), (("--experiment", "--fit", "omega"), "did you mean 'omega0'?")],
)
def test_what_cannot_be_fitted_is_one_line(words: tuple[str, ...], complaint: str) -> None:
    done = invoke(*words)
    assert isinstance(done.exception, FishdError)
    assert complaint in str(done.exception)
    assert "\n" not in str(done.exception)
