"""`fishctl calibrate force` as an operator does it: a real fishd, a virtual Pi under load."""

import re
import signal
import time
from pathlib import Path

import pytest
from rigs.operator_rig import (
    CROSSTALK,
    SENSITIVITY_X,
    SENSITIVITY_Y,
    Bench,
    Dialogue,
    Talk,
    calibrations,
    forces,
)
from rigs.processes import PATIENCE, Daemon

from fishd.client import Fish

GRAM = 9.80665e-3
NOTHING = "not measured: the force sensor delivered no sample"
PLAN = [(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.3), (0.0, -0.3)]


def measure(dialogue: Dialogue, rig: Bench, fx: float, fy: float, size: str | None = None) -> None:
    """Hang a load when the dialogue asks for it, and let it be measured.

    Repeat while the sensor gave nothing, as on a stalled machine: the dialogue asks again.
    """
    deadline = time.monotonic() + PATIENCE
    output = NOTHING
    while NOTHING in output:
        assert time.monotonic() < deadline, dialogue.text
        if size is not None:
            dialogue.answer("load [", size)
        dialogue.expect("Enter when it is still")
        rig.pi.load(fx, fy)
        dialogue.answer(":")
        output = dialogue.expect("\n")
    dialogue.answer("r to measure it again:")


def measure_again(dialogue: Dialogue, rig: Bench, x: float, y: float, size: str = "") -> None:
    """Hang the second load along each axis, in both directions."""
    for load in ((x, 0.0), (-x, 0.0), (0.0, y), (0.0, -y)):
        measure(dialogue, rig, *load, size)


def test_guided_loads_make_true_forces_of_voltages_and_say_how_well_they_are_known(
    talk: Talk, rig: Bench, daemon: Daemon, tmp_path: Path
) -> None:
    record = tmp_path / "loads.csv"
    words = ("--unit", "g", "--seconds", "0.3", "--to", str(record))
    dialogue = talk(daemon, "calibrate", "force", *words)
    plan = dialogue.expect("-y")
    assert all(name in plan for name in ("zero", "+x", "-x", "+y"))
    measure(dialogue, rig, 0.0, 0.0)
    measure(dialogue, rig, +20 * GRAM, 0.0, "20")
    measure(dialogue, rig, -20 * GRAM, 0.0, "")  # as before
    measure(dialogue, rig, 0.0, +30 * GRAM, "30")
    measure(dialogue, rig, 0.0, -30 * GRAM, "30")
    measure_again(dialogue, rig, 25 * GRAM, 25 * GRAM, "25")
    dialogue.answer("Another load", "10 10")
    measure(dialogue, rig, 10 * GRAM, 10 * GRAM)
    dialogue.answer("Another load", "")
    fit = dialogue.answer("save it?", "y")
    assert dialogue.finish() == 0
    assert "over 10 loads" in fit
    assert float(re.search(r"residual ([\d.]+) mN", fit)[1]) < 2.0  # type: ignore[index]
    assert float(re.search(r"condition number ([\d.]+)", fit)[1]) < 3.0  # type: ignore[index]
    match = re.search(r"known to ± ([\d.]+)%: scatter .* ± ([\d.]+)%, .* ± 1.00%", fit)
    total, scatter = map(float, match.groups())
    assert total == pytest.approx((scatter**2 + 1.0) ** 0.5, abs=0.02)
    used = calibrations(daemon).force
    assert used.thrust_ci95(1.0) == pytest.approx(total / 100.0, abs=1e-4)
    assert "covariance_x" in rig.files("force")[-1].read_text()
    assert dialogue.text.endswith(f"saved in {rig.files('force')[-1]}\n")
    for load in ((0.1, -0.2), (-0.05, 0.05), (0.0, 0.0)):
        rig.pi.load(*load)
        assert forces(daemon) == pytest.approx(load, abs=3e-3)
    assert len(record.read_text().splitlines()) == 11


def test_a_doubtful_load_is_pointed_out_and_measured_again_and_none_is_lost(
    talk: Talk, rig: Bench, daemon: Daemon
) -> None:
    still, again = "Enter when it is still:", "r to measure it again:"
    dialogue = talk(daemon, "calibrate", "force", "--seconds", "0.6")
    dialogue.answer(still, "r")
    dialogue.expect("Error: Enter is needed, not 'r'")
    dialogue.answer(still)
    dialogue.answer(again, "x")
    dialogue.expect("Error: Enter or r is needed, not 'x'")
    dialogue.answer(again, "R")
    measure(dialogue, rig, 0.0, 0.0)
    dialogue.answer("load [N]", "0.2")
    rig.pi.load(0.0, 0.0, shaking=0.1)
    dialogue.answer(still)
    assert "not still" in dialogue.answer(again, "r")
    dialogue.answer("load [N]", "")
    rig.pi.load(2.0, 0.0)  # clipped
    dialogue.answer(still)
    assert "warning: suspect: " in dialogue.answer(again, "r")
    dialogue.answer("load [N]", "")
    rig.pi.load(0.2, 0.0)
    rig.pi.inject("unplugged")
    dialogue.answer(still)
    dialogue.expect(NOTHING)
    rig.pi.clear()
    measure(dialogue, rig, 0.2, 0.0, "")
    assert "warning" not in dialogue.expect("backward")
    dialogue.process.send_signal(signal.SIGINT)
    assert dialogue.finish() == 130
    assert "nothing was changed" in dialogue.text


def test_loads_that_make_no_fit_can_be_measured_again_and_none_is_lost(
    talk: Talk, rig: Bench, daemon: Daemon, tmp_path: Path
) -> None:
    record = tmp_path / "loads.csv"
    words = ("--seconds", "0.3", "--yes", "--to", str(record))
    dialogue = talk(daemon, "calibrate", "force", *words)
    measure(dialogue, rig, 0.0, 0.0)
    measure(dialogue, rig, -0.2, 0.0, "0.2")  # pulled the wrong way
    measure(dialogue, rig, -0.2, 0.0, "")
    measure(dialogue, rig, 0.0, 0.2, "")
    measure(dialogue, rig, 0.0, -0.2, "")
    measure_again(dialogue, rig, 0.2, 0.2)
    dialogue.answer("Another load", "7 7")
    measure(dialogue, rig, 0.0, 0.0)
    dialogue.answer("Another load", "")
    dialogue.expect("do not follow the loads")
    assert rig.files("force") == []
    dialogue.answer("Another load", "+z")
    dialogue.expect("or one of zero, +x, -x, +y, -y, +x again")
    dialogue.expect("(7, 7) N is needed")
    dialogue.answer("Another load", "drop (7, 7) N")
    dialogue.answer("Another load", "+x")
    measure(dialogue, rig, 0.2, 0.0, "")
    dialogue.answer("Another load", "")
    dialogue.expect("over 9 loads")
    assert dialogue.finish() == 0
    assert len(record.read_text().splitlines()) == 10
    rig.pi.load(0.1, -0.1)
    assert forces(daemon) == pytest.approx((0.1, -0.1), abs=3e-3)


def test_a_load_beyond_the_force_limit_is_refused(talk: Talk, rig: Bench, daemon: Daemon) -> None:
    dialogue = talk(daemon, "calibrate", "force", "--seconds", "0.2")
    measure(dialogue, rig, 0.0, 0.0)
    dialogue.answer("load [N]", "20")
    dialogue.expect("20 N is beyond force_sensor.force_limit, 10 N; did you mean --unit g?")
    for _ in range(8):
        measure(dialogue, rig, 0.0, 0.0, "0.2")
    dialogue.answer("Another load", "5 -15")
    dialogue.expect("-15 N is beyond force_sensor.force_limit, 10 N; did you mean --unit g?")
    dialogue.expect("Another load")
    assert dialogue.finish() == 130


@pytest.mark.parametrize("how", ["ctrl-c", "end of input", "no"])
def test_without_a_yes_nothing_changes(talk: Talk, rig: Bench, daemon: Daemon, how: str) -> None:
    before = calibrations(daemon)
    measured = rig.folder / "measured.csv"
    measured.write_text("fx_N,fy_N,vx_V,vy_V\n" + "".join(f"{x},{y},{x},{y}\n" for x, y in PLAN))
    dialogue = talk(daemon, "calibrate", "force", "--loads", str(measured))
    dialogue.expect("save it?")
    if how == "ctrl-c":
        dialogue.process.send_signal(signal.SIGINT)
        dialogue.process.wait(PATIENCE)
    elif how == "no":
        dialogue.answer("", "n")
    assert dialogue.finish() == (1 if how == "no" else 130)
    assert "nothing was changed" in dialogue.text
    assert calibrations(daemon) == before
    assert rig.files("force") == []


def test_a_plan_from_a_file_is_measured_in_order(talk: Talk, rig: Bench, daemon: Daemon) -> None:
    plan = rig.folder / "plan.csv"
    plan.write_text("fx,fy\n" + "".join(f"{x / GRAM},{y / GRAM}\n" for x, y in PLAN))
    dialogue = talk(
        daemon, "calibrate", "force", "--loads", str(plan), "--unit", "g", "--seconds", "0.3",
        "--yes",
    )  # fmt: skip
    for load in PLAN:
        measure(dialogue, rig, *load)
    dialogue.answer("Another load")
    assert dialogue.finish() == 0
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        calibration = fish.calibrations().force
    determinant = 1 - CROSSTALK**2
    assert calibration.xx == pytest.approx(1 / SENSITIVITY_X / determinant, rel=0.02)
    assert calibration.yy == pytest.approx(1 / SENSITIVITY_Y / determinant, rel=0.02)


def test_loads_outlive_a_fishd_without_an_answer(talk: Talk, rig: Bench, daemon: Daemon) -> None:
    dialogue = talk(daemon, "calibrate", "force", "--seconds", "0.3", "--yes")
    measure(dialogue, rig, 0.0, 0.0)
    measure(dialogue, rig, 0.2, 0.0, "0.2")
    dialogue.answer("load [N]")
    rig.pi.load(-0.2, 0.0)
    daemon.stop()
    try:
        dialogue.answer("Enter when it is still")
        dialogue.expect("not measured: no answer within")
    finally:
        daemon.process.send_signal(signal.SIGCONT)
    daemon.at_rest()
    measure(dialogue, rig, -0.2, 0.0, "")
    measure(dialogue, rig, 0.0, 0.2, "")
    measure(dialogue, rig, 0.0, -0.2, "")
    measure_again(dialogue, rig, 0.2, 0.2)
    rig.pi.load(0.0, 0.0)
    assert daemon.fishctl("set-controller", "swing").returncode == 0
    dialogue.answer("Another load")
    assert "stop it with 'fishctl stop'" in dialogue.expect("Enter to try again")
    assert rig.files("force") == []
    daemon.at_rest()
    dialogue.answer(":")
    dialogue.expect("saved in ")
    assert dialogue.finish() == 0
    assert len(rig.files("force")) == 1


def test_a_full_disk_costs_no_load(talk: Talk, rig: Bench, daemon: Daemon, tmp_path: Path) -> None:
    record = tmp_path / "folder" / "loads.csv"
    record.parent.mkdir()
    words = ("--seconds", "0.6", "--yes", "--to", str(record))
    dialogue = talk(daemon, "calibrate", "force", *words)
    measure(dialogue, rig, 0.0, 0.0)
    dialogue.expect("load [N]")
    record.unlink()
    record.parent.rmdir()
    dialogue.answer("", "0.2")
    dialogue.expect("Enter when it is still")
    rig.pi.load(0.2, 0.0)
    dialogue.answer(":")
    dialogue.answer("r to measure it again:")
    dialogue.expect(f"warning: {record}: cannot be written: No such file or directory")
    record.parent.mkdir()
    measure(dialogue, rig, -0.2, 0.0, "")
    dialogue.expect("load [N]")
    assert len(record.read_text().splitlines()) == 4
