"""Robots of other packages: one class and one entry point."""

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.example_packages import forget_drivers
from rigs.processes import fishctl, install

from fishd.config import check_tethered, json_schema, load
from fishd.core.errors import ConfigError, StartupError
from fishd.lab.simulation.virtual_run import KeepingPublisher, VirtualRun

CODE = """
from typing import Annotated
from msgspec import Struct
from fishd.core.robots import RobotKind
from fishd.core.schema import Problem, convert, unit
from fishd.core.signals import Measurement
from fishd.hardware.base import Robot
from fishd.virtual.plant.base import TrueWindow

class Keys(Struct, frozen=True, forbid_unknown_fields=True):
    gain: Annotated[float, unit("N/rad", "Force per angle.", gt=0, le=1)] = 0.1

class Fish:
    def __init__(self, gain):
        self.gain, self.angle = gain, 0.0
    def read(self, now):
        return Measurement(now, self.gain * abs(self.angle), 0.0, 1)
    def write(self, angle):
        self.angle = angle
    def release(self):
        self.angle = 0.0
    close = release
    def take_window(self):
        return TrueWindow(0.05, self.gain * abs(self.angle), 0.0)
    def robot(self):
        return Robot("twin", self, self)

class Twin(RobotKind):
    Settings = Keys
    @staticmethod
    def check(config):
        if config.tick < 0.02:
            raise Problem(("tick",), "its link is too slow: 0.02 s is needed")
    @staticmethod
    def open(config):
        return Fish(convert(config.robot_settings, Keys).gain)

class Drifter(Twin):
    is_tethered = False

class Broken(RobotKind):
    @staticmethod
    def open(config):
        raise SystemExit("no cable")

class Leaving(RobotKind):
    @staticmethod
    def check(config):
        raise SystemExit(0)

class Five(RobotKind):
    @staticmethod
    def open(config):
        return 5
"""

KINDS = ("twin", "drifter", "broken", "leaving", "five")


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    module = f"robots_{tmp_path.name}"  # of this test alone
    classes = {name: f"{module}:{name.capitalize()}" for name in KINDS}
    install(tmp_path, {module: CODE}, group="fishd.robots", **classes)
    monkeypatch.syspath_prepend(str(tmp_path))
    forget_drivers()
    yield
    forget_drivers()


@pytest.mark.slow
def test_a_robot_of_another_package_swims_with_its_settings_and_its_name() -> None:
    config = load(None, ["robot=twin", "robot_settings.gain=0.5"])
    publisher = KeepingPublisher()
    with VirtualRun(config, publisher) as run:
        run.set_controller("square", {"frequency": 2.0, "amplitude": 0.4})
        for _ in range(4):
            run.tick()
        assert run.about()["robot"] == "twin"
    assert publisher.ticks[-1].fx == pytest.approx(0.2)
    done = fishctl("simulate", "square", "--for", "12", "--set", "robot=twin")
    assert "thrust" in done.stdout
    assert "relative" not in done.stdout, "its best square wave is not that of section plant"
    done = fishctl("simulate", "square", "--for", "12", "--set", "robot=twin", "--json")
    report = json.loads(done.stdout)
    assert report["mean_thrust"] > 0.0
    assert not {"relative_thrust", "best_square_thrust", "best_square_frequency"} & set(report)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "result"),
    [
        (("compare", "square", "swing:C=0.5"), "Verdict: "),
        (("optimise", "square", "--frequency", "1:3", "--budget", "25"), "true thrust there: "),
        (("sweep", "square", "--frequency", "1.5,1.7", "--jobs", "1"), "best measured at "),
    ],
)
def test_no_verb_compares_one_with_the_best_square_wave_of_section_plant(
    tmp_path: Path, words: tuple[str, ...], result: str
) -> None:
    folder = tmp_path / "run"
    done = fishctl(*words, "--set", "robot=twin", "--folder", str(folder))
    assert result in done.stdout, done.stderr
    assert "best square wave" not in done.stdout
    assert "relative" not in done.stdout
    if words[0] == "sweep":
        (row, _) = csv.DictReader((folder / "rows.csv").read_text().splitlines())
        assert row["relative_thrust"] == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (["robot=twni"], "no robot is named 'twni'; did you mean 'twin'?; installed: broken, "),
        (["robot=twin", "robot_settings.gain=2"], "robot_settings.gain: 2 is not valid: a number"),
        (["robot=twin", "robot_settings.gian=1"], "robot_settings.gian: unknown key"),
        (["robot=twin", "tick=0.01"], "tick: its link is too slow: 0.02 s is needed"),
        (["robot=leaving"], "robot: the check of 'leaving' failed: SystemExit"),
        (["robot_settings.gain=0.1"], "robot_settings.gain: unknown key"),
    ],
)
def test_one_that_cannot_be_used_is_one_line(settings: list[str], complaint: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(None, settings)
    assert complaint in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_one_that_cannot_start_says_why_and_one_that_is_free_has_no_thrust() -> None:
    with pytest.raises(StartupError, match=r"^robot 'broken' cannot start: SystemExit: no cable$"):
        VirtualRun(load(None, ["robot=broken"]), None)
    with pytest.raises(StartupError, match=r"^robot 'five' cannot start: .*open returned 5, which"):
        VirtualRun(load(None, ["robot=five"]), None)
    with pytest.raises(ConfigError, match=r"^robot: drifter is not valid for optimum, which needs"):
        check_tethered("drifter", "optimum")
    assert "twin" in json_schema()["$defs"]["Config"]["properties"]["robot"]["enum"]
