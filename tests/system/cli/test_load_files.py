"""Files of loads for `fishctl calibrate force`: fitted, and refused in one line."""

import re
from pathlib import Path

import pytest
from rigs.operator_rig import Bench, fishctl_alone
from rigs.processes import PATIENCE, Daemon, one_line

from fishd.client import Fish

GRAM = 9.80665e-3
PLAN = [(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.3), (0.0, -0.3)]


@pytest.mark.parametrize("volts", ["", ",0,0"])
def test_a_load_beyond_the_force_limit_is_refused_in_a_file(
    rig: Bench, daemon: Daemon, volts: str
) -> None:
    loads = rig.folder / "loads.csv"
    lines = [f"{100 * x:g},{100 * y:g}{volts}" for x, y in PLAN]
    header = "fx_N,fy_N" + (",vx_V,vy_V" if volts else "")
    loads.write_text("\n".join([header, *lines, ""]))
    ended = daemon.fishctl("calibrate", "force", "--loads", str(loads), "--yes")
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == (
        f"fishctl: {loads}:3: 20 N is beyond force_sensor.force_limit, 10 N; are these grams? Then "
        "name the columns fx_g,fy_g\n"
    )
    loads.write_text("\n".join([header.replace("_N", "_g"), *lines, ""]))
    ended = daemon.fishctl("calibrate", "force", "--loads", str(loads), "--yes")
    assert "force_limit" not in ended.stderr


def test_what_was_measured_earlier_cannot_be_recorded(tmp_path: Path) -> None:
    measured = tmp_path / "measured.csv"
    measured.write_text("fx_N,fy_N,vx_V,vy_V\n" + "".join(f"{x},{y},{x},{y}\n" for x, y in PLAN))
    record = tmp_path / "record.csv"
    words = ("--loads", str(measured), "--to", str(record))
    ended = fishctl_alone(tmp_path, "calibrate", "force", *words)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert re.match(rf"fishctl: --to keeps what .* {measured} holds .*\n$", ended.stderr)
    assert not record.exists()


def test_the_file_for_recorded_loads_is_checked_before_the_first_load(
    rig: Bench, daemon: Daemon, tmp_path: Path
) -> None:
    record = tmp_path / "loads.csv"
    record.write_text("precious\n")
    words = ("calibrate", "force", "--to")
    ended = daemon.fishctl(*words, str(record))
    assert one_line(ended) == f"fishctl: {record}: is there already; --force replaces it\n"
    assert record.read_text() == "precious\n"
    ended = daemon.fishctl(*words, str(tmp_path / "none" / "loads.csv"), "--force")
    assert one_line(ended).endswith("none/loads.csv: its folder does not exist; create it\n")


def test_a_refusal_for_now_names_the_file_with_the_loads(rig: Bench, daemon: Daemon) -> None:
    measured = rig.folder / "measured.csv"
    measured.write_text("fx_N,fy_N,vx_V,vy_V\n" + "".join(f"{x},{y},{x},{y}\n" for x, y in PLAN))
    words = ("calibrate", "force", "--yes", "--loads", str(measured))
    assert daemon.fishctl("set-controller", "swing").returncode == 0
    ended = daemon.fishctl(*words)
    assert ended.returncode == 1
    assert re.fullmatch(
        rf"fishctl: [^\n]+ 'fishctl stop'; then run this again: the loads are in {measured} "
        r"\[running\]\n",
        ended.stderr,
    )
    daemon.at_rest()
    assert daemon.fishctl(*words).returncode == 0


def test_loads_of_a_file_without_a_fit_are_refused_despite_yes(rig: Bench, daemon: Daemon) -> None:
    noise = [(0.3, 0.1), (-0.2, 0.3), (0.4, -0.2), (0.1, 0.4), (-0.3, -0.3)]
    measured = rig.folder / "noise.csv"
    lines = [f"{x},{y},{vx},{vy}" for (x, y), (vx, vy) in zip(PLAN, noise, strict=True)]
    measured.write_text("\n".join(["fx_N,fy_N,vx_V,vy_V", *lines, ""]))
    ended = daemon.fishctl("calibrate", "force", "--loads", str(measured), "--yes")
    assert ended.returncode == 1
    assert "errors [mN]" in ended.stdout
    doubt = r"fishctl: the voltages do not follow the loads: .* measure load \d again.*\n"
    assert re.fullmatch(doubt, ended.stderr)
    assert rig.files("force") == []


def test_loads_measured_earlier_are_fitted_without_a_question(rig: Bench, daemon: Daemon) -> None:
    measured = rig.folder / "measured.csv"
    lines = [f"{x / GRAM}, {y / GRAM}, {2 * x + 0.3}, {1.5 * y - 0.2}, ignored" for x, y in PLAN]
    measured.write_text("\n".join(["fx_g, fy_g, vx_V, vy_V, remark", *lines, ""]))
    ended = daemon.fishctl("calibrate", "force", "--loads", str(measured), "--yes")
    assert (ended.returncode, ended.stderr) == (0, "")
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fit = fish.calibrations().force
    assert (fit.xx, fit.xy, fit.x0) == pytest.approx((0.5, 0.0, -0.15))
    assert (fit.yx, fit.yy, fit.y0) == pytest.approx((0.0, 1 / 1.5, 0.2 / 1.5))
    assert (fit.loads, fit.residual) == (5, pytest.approx(0.0, abs=1e-12))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("fx_N,fy_N,vx_V,vy_V\n0,0,0,0\n1,0,1,0\n", r"a load along -x is missing"),
        ("fx_N,fy_N\n0,0\n1,0\n-1,0\n2,0\n3,0\n", r"a load along \+y is missing"),
        ("fx_N,fy_N,vx_V\n0,0,0\n", r":1: vx_V and vy_V are needed"),
        ("force,volts\n0,0\n", r":1: one column fx_N or fx_g is needed"),
        ("fx_N,fy_N\n0,0\n0.1,\n", r":3: fy_N: '' is not a number"),
        ("fx_N,fy_N\n0,nan\n", r":2: fy_N: 'nan' is not a number"),
        ("fx_N,fy_N\n", r"no loads below the header"),
        (None, r"no such file"),
    ],
)
def test_a_wrong_file_of_loads_is_refused_in_one_line(
    tmp_path: Path, text: str | None, complaint: str
) -> None:
    path = tmp_path / "loads.csv"
    if text is not None:
        path.write_text(text)
    ended = fishctl_alone(tmp_path, "calibrate", "force", "--loads", str(path), "--yes")
    assert (ended.returncode, ended.stdout) == (1, "")
    assert re.fullmatch(rf"fishctl: {path}[^\n]*{complaint}[^\n]*\n", ended.stderr)
