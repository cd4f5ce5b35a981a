"""Reports of a reversed F_y: in status, in doctor, and in calibrate force."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest
from rigs.doctor_process import doctor
from rigs.operator_rig import Bench
from rigs.processes import PATIENCE, Daemon, wait_until

from fishd.client import Fish
from fishd.core.calibration import ForceCalibration

LINE = (
    "F_y is reversed: it pushed in the direction in which the tail began to move, "
    "so controllers are shown it with the other sign"
)

REST_TICKS, PUSH_TICKS = 50, 40
"""Durations of rest and first push that suffice to judge the sign of F_y [ticks]."""


def loads_file(folder: Path, sign: int) -> str:
    """Write a file of measured loads, with +y and -y interchanged for sign -1; return its path."""
    forces = [(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.3), (0.0, -0.3)]
    rows = "".join(f"{x},{y},{x},{sign * y}\n" for x, y in forces)
    file = folder / f"loads{sign}.csv"
    file.write_text(f"fx_N,fy_N,vx_V,vy_V\n{rows}")
    return str(file)


def swim_until_judged(fish: Fish) -> None:
    """Set off from rest; repeat if a stall of the machine hid the first push."""
    deadline = time.monotonic() + PATIENCE
    while fish.status().fy_reversed is None:
        assert time.monotonic() < deadline
        wait_until(lambda: fish.status().phi_c == 0.0)
        wait_for_ticks(fish, REST_TICKS, lambda: False)
        fish.set_controller("square", frequency=1.0)
        wait_for_ticks(fish, PUSH_TICKS, lambda: fish.status().fy_reversed is not None)
        fish.stop()


def wait_for_ticks(fish: Fish, ticks: int, earlier: Callable[[], bool]) -> None:
    """Wait until a number of ticks has passed, or `earlier` returns true."""
    seq = fish.status().seq
    wait_until(lambda: fish.status().seq > seq + ticks or earlier())


@pytest.fixture
def interchanged(rig: Bench, daemon: Daemon) -> Daemon:
    """The fishd, calibrated with +y and -y interchanged, after a swim."""
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.calibrate_force(ForceCalibration(yy=-1.0, loads=5))
        assert fish.status().fy_reversed is None
        swim_until_judged(fish)
    return daemon


def test_status_doctor_and_calibrate_force_say_it_and_the_right_calibration_ends_it(
    rig: Bench, interchanged: Daemon
) -> None:
    shown = " ".join(interchanged.fishctl("status").stdout.split())
    assert LINE in shown
    assert "fishctl calibrate force" in shown
    _, findings = doctor(rig.folder, *rig.settings)
    level, message = findings["daemon"]
    assert level == "warning"
    assert LINE in message

    calibrate = ("calibrate", "force", "--yes", "--loads")
    wrong = interchanged.fishctl(*calibrate, loads_file(rig.folder, -1))
    assert "reversed, as the last start of the tail has shown, and this calibration" in wrong.stderr
    assert interchanged.fishctl(*calibrate, loads_file(rig.folder, 1)).stderr == ""
    assert LINE not in interchanged.fishctl("status").stdout


def test_a_calibration_that_would_reverse_a_force_is_doubted(rig: Bench, daemon: Daemon) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        swim_until_judged(fish)
        assert fish.status().fy_reversed is False
        wait_until(lambda: fish.status().phi_c == 0.0)
    ended = daemon.fishctl("calibrate", "force", "--loads", loads_file(rig.folder, -1), "--yes")
    assert "reverses F_y, whose sign was right at the last start of the tail" in ended.stderr
