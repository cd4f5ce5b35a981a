"""Each program reports a missing library of a driver in one line."""

import json
import os
import re
from pathlib import Path

import pytest
from rigs.documents import ROOT
from rigs.operator_rig import Bench
from rigs.processes import FISHCTL, FISHD, addresses, call, sets

from fishd.hardware import registry

MODULES = ("pigpio", "adafruit_extended_bus", "adafruit_ads1x15", "Adafruit_PureIO")
ONE_LINE = r"[^\n]*the package %s is missing; install fishd\[pi\]\n"


def environment_without(folder: Path, *modules: str) -> dict[str, str]:
    """Return the environment of a Python that cannot import these modules."""
    blocked = "".join(f"sys.modules[{name!r}] = None\n" for name in modules)
    (folder / "sitecustomize.py").write_text(f"import sys\n{blocked}")
    return os.environ | {"PYTHONPATH": f"{folder}:{ROOT}"}


@pytest.fixture
def env(tmp_path: Path) -> dict[str, str]:
    """Environment without the libraries of drivers."""
    return environment_without(tmp_path, *MODULES)


@pytest.mark.parametrize(
    ("modules", "settings", "package"),
    [
        (MODULES, [], "adafruit-extended-bus"),
        (["gpiod"], ["panel.estop_gpio=17"], "gpiod"),
    ],
)
def test_fishd_on_a_virtual_pi_names_the_package(
    pi: Bench, tmp_path: Path, modules: list[str], settings: list[str], package: str
) -> None:
    env = environment_without(tmp_path, *modules)
    ended = call(FISHD, *pi.settings, *sets(*settings), *addresses(pi.folder), env=env)
    assert ended.returncode == 1
    assert re.fullmatch(ONE_LINE % package, ended.stderr)


@pytest.mark.parametrize(
    ("modules", "settings", "complaint"),
    [
        (MODULES, [], ONE_LINE % "adafruit-circuitpython-ads1x15"),
        (["gpiod"], ["panel.estop_gpio=9"], r"[^\n]*need the package gpiod[^\n]*\n"),
    ],
)
def test_fishd_on_a_pi_does_not_start_without_what_it_needs(
    tmp_path: Path, modules: list[str], settings: list[str], complaint: str
) -> None:
    env = environment_without(tmp_path, *modules)
    with (tmp_path / "sitecustomize.py").open("a") as file:  # another fishd may hold these pins
        file.write(
            "from fishd.core.process import kernel_names\n"
            f"kernel_names._PREFIX = 'test-{os.getpid()}'\n"
        )
    pi = sets("robot=pi", "force_sensor.bus=255", *settings)  # no machine has this bus
    paths = [*sets(f"state_folder={tmp_path}"), *addresses(tmp_path)]
    ended = call(FISHD, *pi, *paths, env=env)
    assert ended.returncode == 1
    assert re.fullmatch(complaint, ended.stderr)


def test_no_check_of_doctor_breaks_off(pi: Bench, env: dict[str, str]) -> None:
    ended = call(FISHCTL, "doctor", "--json", *pi.settings, *addresses(pi.folder), env=env)
    assert (ended.returncode, ended.stderr) == (1, "")
    findings = {line["check"]: line for line in json.loads(ended.stdout)}
    for name in ("adc", "force", "pigpiod"):
        assert findings[name]["level"] == "FAIL"
        assert findings[name]["message"].endswith(" is missing; install fishd[pi]")
        assert findings[name]["remedy"].endswith("[pi]'")
    assert "ModuleNotFoundError" not in ended.stdout
    assert "broke off" not in ended.stdout


def test_a_package_that_is_there_but_broken_is_not_called_missing() -> None:
    error = ImportError("cannot import name 'ADS1115'", name="adafruit_ads1x15.ads1115")
    assert registry.why_not_imported(error) == (
        "the package adafruit-circuitpython-ads1x15 cannot be imported (cannot import name "
        "'ADS1115'); install fishd[pi]"
    )


@pytest.mark.parametrize("missing", [["torch"], ["torch", "gymnasium", "stable_baselines3"]])
def test_training_without_the_extra_names_it_in_a_line(tmp_path: Path, missing: list[str]) -> None:
    env = environment_without(tmp_path, *missing)
    done = call(FISHCTL, "learn", "ppo", "--folder", tmp_path / "run", env=env)
    assert done.returncode == 1
    assert re.fullmatch(
        r"fishctl: \w+ is not installed; install it with: \S+ -m pip install [^\n]+\[learn\]'\n",
        done.stderr,
    )
    assert not (tmp_path / "run").exists()
    shown = call(FISHCTL, "learn", "ppo", "--help", env=env)
    assert (shown.returncode, "--resume" in shown.stdout) == (0, True)


NOT_INSTALLED = r"fishctl: %s is not installed; [^\n]*\[%s\]'\n"


@pytest.mark.parametrize(
    ("line", "missing", "complaint"),
    [
        ("fishd-camera --set source=v4l2", ["cv2"], r"[^\n]*cv2[^\n]*\[camera\]'\n"),
        ("fishd-camera --set source=v4l2", ["linuxpy"], r"[^\n]*linuxpy[^\n]*\[camera\]'\n"),
        ("release --set robot=pi", MODULES, ONE_LINE % "pigpio"),
        ("simulate hold --set robot=virtual-pi", MODULES, ONE_LINE % "adafruit-extended-bus"),
        ("agent default-fish", ["onnx"], NOT_INSTALLED % ("onnx", "policy")),
        ("agent default-fish", ["onnxruntime"], NOT_INSTALLED % ("onnxruntime", "policy")),
        ("camera page --listen 127.0.0.1:0", ["aiohttp"], r"fishd-window: [^\n]*\[window\]'\n"),
        ("record run", ["mcap"], NOT_INSTALLED % ("mcap", "record")),
    ],
)
def test_a_verb_names_the_package_or_the_extra_that_it_lacks(
    tmp_path: Path, line: str, missing: list[str], complaint: str
) -> None:
    words = line.split() if line.startswith("fishd") else ["fishctl", *line.split()]
    program = Path(FISHCTL).with_name(words[0])
    done = call(program, *words[1:], env=environment_without(tmp_path, *missing))
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(complaint, done.stderr)
