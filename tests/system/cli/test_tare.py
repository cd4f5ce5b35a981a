"""`fishctl tare`, and requests that all verbs about calibrations refuse, on a real fishd."""

import math
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.operator_rig import Bench, fishctl_alone, forces
from rigs.processes import FISHCTL, Daemon, Process, running


def test_a_tare_sets_the_zero_to_the_present_force_and_says_so(rig: Bench, daemon: Daemon) -> None:
    before = forces(daemon)
    assert math.hypot(*before) > 0.3  # the voltages of the bridge without a load
    ended = daemon.fishctl("tare", "--seconds", "0.6")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert re.search(r"before +x0 +\+0\.00 mN", ended.stdout)
    assert str(rig.files("force")[-1]) in ended.stdout
    assert forces(daemon) == pytest.approx((0.0, 0.0), abs=2e-3)


def test_a_tare_that_cannot_be_trusted_is_refused_in_one_line(rig: Bench, daemon: Daemon) -> None:
    rig.pi.load(0.0, 0.0, shaking=0.1)
    restless = daemon.fishctl("tare", "--seconds", "1.2")
    rig.pi.load(0.5, 0.0)
    large = daemon.fishctl("tare", "--seconds", "0.6")
    rig.pi.load(0.0, 0.0)
    daemon.fishctl("set-controller", "swing")
    swimming = daemon.fishctl("tare", "--seconds", "0.6")
    for ended, code in ((restless, "not-still"), (large, "too-large"), (swimming, "running")):
        assert (ended.returncode, ended.stdout) == (1, "")
        assert re.fullmatch(rf"fishctl: [^\n]+ \[{code}\]\n", ended.stderr)
    assert rig.files("force") == []


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_tare_that_is_given_up_changes_nothing(rig: Bench, daemon: Daemon, how: int) -> None:
    seconds = 6.0
    tare = Process(FISHCTL, "--endpoint", daemon.endpoint, "tare", "--seconds", str(seconds))
    time.sleep(1.5)  # it measures
    assert tare.end(how)[0] != 0
    forces(daemon, seconds)  # starts later and takes as long: the tare would have ended
    assert math.hypot(*forces(daemon)) > 0.3
    assert rig.files("force") == []


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    folder = tmp_path_factory.mktemp("simulated")
    with running(folder, "--set", "simulation.offset_x=0.02") as daemon:
        yield daemon


def test_a_tare_of_a_simulated_fish_lasts_until_it_ends(simulated: Daemon) -> None:
    assert forces(simulated)[0] == pytest.approx(0.02, abs=2e-3)
    ended = simulated.fishctl("tare")
    assert ended.stdout.splitlines()[-1] == "in use, until this fish ends"
    assert forces(simulated)[0] == pytest.approx(0.0, abs=2e-3)


def test_a_simulated_fish_has_nothing_to_calibrate(simulated: Daemon) -> None:
    for verb in (("calibrate", "force"), ("calibrate", "servo")):
        ended = simulated.fishctl(*verb)
        assert ended.returncode == 1
        assert re.fullmatch(r"fishctl: a simulated fish .* \[simulated\]\n", ended.stderr)


def test_without_a_daemon_nothing_can_be_calibrated(tmp_path: Path) -> None:
    for verb in (("tare",), ("calibrate", "force"), ("calibrate", "servo")):
        ended = fishctl_alone(tmp_path, *verb)
        assert ended.returncode == 1
        assert re.fullmatch(r"fishctl: no fishd at [^\n]*\n", ended.stderr)
