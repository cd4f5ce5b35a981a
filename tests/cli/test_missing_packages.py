"""Where a driver's library is not installed, each program says so in one line."""

import json
import os
import re
import subprocess
from pathlib import Path

import pytest
from operator_rig import Bench
from processes import FISHCTL, FISHD, PATIENCE

from fishd.hardware import ownership, packages

MODULES = ("pigpio", "adafruit_extended_bus", "adafruit_ads1x15", "Adafruit_PureIO")
ONE_LINE = r"[^\n]*the package %s is missing; install fishd\[pi\]\n"


@pytest.fixture
def without(tmp_path: Path) -> dict[str, str]:
    """The environment of a Python that cannot import the drivers."""
    blocked = "".join(f"sys.modules[{name!r}] = None\n" for name in MODULES)
    (tmp_path / "sitecustomize.py").write_text(f"import sys\n{blocked}")
    return os.environ | {"PYTHONPATH": str(tmp_path)}


def call(env: dict[str, str], *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=PATIENCE, env=env
    )


def own(folder: Path) -> list[str]:
    settings = (f"control.address=ipc://{folder}/control", "telemetry.address=tcp://127.0.0.1:0")
    return [word for setting in settings for word in ("--set", setting)]


def test_fishd_on_a_virtual_pi_names_the_package(pi: Bench, without: dict[str, str]) -> None:
    ended = call(without, FISHD, *pi.settings, *own(pi.folder))
    assert ended.returncode == 1
    assert re.fullmatch(ONE_LINE % "adafruit-extended-bus", ended.stderr)


def test_fishd_on_a_pi_names_the_package(tmp_path: Path, without: dict[str, str]) -> None:
    bus = 100 + os.getpid() % 50  # that no machine has
    pi = ("--set", "robot=pi", "--set", f"force_sensor.bus={bus}", "--set", "servo.gpio=7")
    ended = call(without, FISHD, *pi, "--set", f"state_folder={tmp_path}", *own(tmp_path))
    for lock in (f"fishd-i2c-{bus}.lock", "fishd-gpio7.lock"):
        (ownership.FOLDER / lock).unlink(missing_ok=True)
    assert ended.returncode == 1
    assert re.fullmatch(ONE_LINE % "adafruit-circuitpython-ads1x15", ended.stderr)


def test_fishd_does_not_start_with_a_button_that_it_cannot_read(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['RPi'] = None\n")
    bus = 150 + os.getpid() % 50  # that no machine has
    settings = ("robot=pi", f"force_sensor.bus={bus}", "servo.gpio=8", "panel.estop_gpio=9")
    pi = [word for setting in settings for word in ("--set", setting)]
    env = os.environ | {"PYTHONPATH": str(tmp_path)}
    ended = call(env, FISHD, *pi, "--set", f"state_folder={tmp_path}", *own(tmp_path))
    for lock in (f"fishd-i2c-{bus}.lock", "fishd-gpio8.lock"):
        (ownership.FOLDER / lock).unlink(missing_ok=True)
    assert ended.returncode == 1
    assert "E-stop button, status light and servo driver rpi-gpio need" in ended.stderr


def test_release_names_the_package(tmp_path: Path, without: dict[str, str]) -> None:
    settings = ("--set", "robot=pi", "--set", f"state_folder={tmp_path}")
    ended = call(without, FISHCTL, "release", *settings)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert re.fullmatch(ONE_LINE % "pigpio", ended.stderr)


def test_a_simulation_of_the_virtual_pi_names_the_package(without: dict[str, str]) -> None:
    ended = call(without, FISHCTL, "simulate", "hold", "--set", "robot=virtual-pi")
    assert ended.returncode == 1
    assert re.fullmatch(ONE_LINE % "adafruit-extended-bus", ended.stderr)


def test_no_check_of_doctor_breaks_off(pi: Bench, without: dict[str, str]) -> None:
    doctor = (FISHCTL, "doctor", "--json", *pi.settings, *own(pi.folder))
    ended = call(without, *doctor)
    assert (ended.returncode, ended.stderr) == (1, "")
    found = {line["check"]: line for line in json.loads(ended.stdout)}
    for name in ("adc", "force", "pigpiod"):
        assert found[name]["level"] == "FAIL"
        assert found[name]["message"].endswith(" is missing; install fishd[pi]")
        assert found[name]["mend"].endswith("-m pip install 'fishd[pi]'")
    assert "ModuleNotFoundError" not in ended.stdout
    assert "broke off" not in ended.stdout


def test_a_package_that_is_there_but_broken_is_not_called_missing() -> None:
    error = ImportError("cannot import name 'ADS1115'", name="adafruit_ads1x15.ads1115")
    assert packages.describe(error) == (
        "the package adafruit-circuitpython-ads1x15 cannot be imported (cannot import name "
        "'ADS1115'); install fishd[pi]"
    )
