"""The package in docs/example-controller, installed and used as its reader would."""

import json
from pathlib import Path

import pytest
from rigs import processes
from rigs.documents import ROOT
from rigs.example_packages import fishctl

pytestmark = pytest.mark.slow  # it starts processes
EXAMPLES = "example-controller"


@pytest.mark.usefixtures("_installed")
def test_the_example_swims_in_virtual_time_and_sweeps_its_frequency() -> None:
    def frequency(*run: str) -> float:
        done = processes.fishctl("simulate", "chirp", "--json", *run)
        assert done.returncode == 0, done.stderr
        report = json.loads(done.stdout)
        assert report["mode"] == "running"
        assert report["mean_thrust"] > 0.0
        return float(report["frequency"])

    on_the_way_up = frequency("--seconds", "20", "--settle", "5")
    at_the_top = frequency("--seconds", "65", "--settle", "55")
    on_the_way_down = frequency("--seconds", "115", "--settle", "100")
    assert on_the_way_up == pytest.approx(1.0, abs=0.1)
    assert at_the_top == pytest.approx(2.9, abs=0.1)
    assert on_the_way_down == pytest.approx(1.0, abs=0.1)


@pytest.mark.usefixtures("_installed")
def test_its_options_show_bounds_units_and_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    shown = " ".join(processes.fishctl("simulate", "chirp", "--help").stdout.split())
    assert "Sweep a square wave's frequency up and down" in shown
    assert "--lowest NUMBER Frequency at which the sweep begins. A number in (0, 10] Hz" in shown
    assert "--sweep-time NUMBER Time from lowest to highest. A number in [1, 3600] s;" in shown


def test_it_is_listed_beside_the_controllers_that_come_with_fishd(site: Path) -> None:
    listed = json.loads(fishctl(site, "controllers", "--json").stdout)
    known = {info["name"]: info for info in listed}
    assert {"chirp", "square", "swing"} <= set(known)
    parameters = {field["name"]: field for field in known["chirp"]["parameters"]}
    assert parameters["highest"]["unit"] == "Hz"
    assert parameters["highest"]["low_open"]
    assert parameters["highest"]["high"] == 10
    assert parameters["amplitude"]["optional"]
    assert [quantity["name"] for quantity in known["chirp"]["quantities"]] == ["frequency"]


def test_it_can_be_named_in_the_configuration(site: Path, tmp_path: Path) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text("start:\n  controller: chirp\n  parameters:\n    sweep_time: 120\n")
    assert fishctl(site, "config", "check", str(file)).returncode == 0


@pytest.mark.usefixtures("_installed")
@pytest.mark.parametrize(
    ("option", "complaint"),
    [
        ("--highest=20", "chirp: highest: 20.0 is not valid: a number in (0, 10] Hz is needed"),
        ("--highest=0.2", "chirp: highest: 0.2 Hz must be above lowest, 0.5 Hz"),
        ("--amplitude=0.5", "chirp: amplitude: 0.5 rad is beyond the robot's amplitude_limit"),
    ],
    ids=["out of its bounds", "at odds with another", "beyond the robot"],
)
def test_a_bad_parameter_is_one_line(option: str, complaint: str) -> None:
    done = processes.fishctl("simulate", "chirp", option)
    assert done.returncode == 1
    assert done.stderr.startswith(f"fishctl: {complaint}")
    assert done.stderr.count("\n") == 1
    assert not done.stdout


def test_the_page_about_it_shows_what_a_run_prints(site: Path) -> None:
    page = (ROOT / "docs" / "how-to" / "writing-a-controller.md").read_text(encoding="utf-8")
    shown = page.partition("$ fishctl simulate chirp --for 130\n")[2].partition("timing ")[0]
    swum = fishctl(site, "simulate", "chirp", "--for", "130").stdout
    assert shown == swum.split("timing ")[0]


@pytest.mark.parametrize("name", ["fishd_chirp.py", "pyproject.toml"])
def test_the_page_about_it_shows_the_code_as_it_is(name: str) -> None:
    page = (ROOT / "docs" / "how-to" / "writing-a-controller.md").read_text(encoding="utf-8")
    source = (ROOT / "docs" / "example-controller" / name).read_text(encoding="utf-8")
    shown = [block.partition("\n")[2].strip() for block in page.split("```")[1::2]]
    parts = [source.strip()] if name.endswith("toml") else source.split("\n\n\n")[-2:]
    for part in parts:
        assert any(part.strip() in block for block in shown), part
