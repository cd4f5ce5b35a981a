"""A servo that cannot go as far as ±Φ: refused where pulses end, shown where limits are chosen."""

import datetime
import json
from pathlib import Path

import pytest
from rigs.operator_rig import Bench, calibrations
from rigs.processes import PATIENCE, fishctl

from fishd.client import Fish
from fishd.config import load
from fishd.core.calibration import ServoCalibration
from fishd.core.errors import ConfigError
from fishd.hardware.calibration_files import CalibrationFolder
from fishd.hardware.servo import pulses
from fishd.hardware.settings import ServoSettings


@pytest.mark.parametrize(
    ("highest", "shown"),
    [(1.2, "within ±0.42 rad\n"), (0.3, "within -0.42 to +0.3 rad, less than ±0.42 rad")],
)
def test_status_shows_the_range_without_a_complaint(pi: Bench, highest: float, shown: str) -> None:
    with pi.daemon("--set", f"servo.highest={highest}") as daemon:
        status = json.loads(daemon.fishctl("status", "--json").stdout)
        assert (status["lowest_angle"], status["highest_angle"]) == (-0.42, min(highest, 0.42))
        assert not any("servo" in line for line in status["limitations"])
        assert shown in daemon.fishctl("status").stdout
        _, _, err = daemon.end()
    cut = "servo.lowest and servo.highest permit -0.42 to +0.3 rad of ±0.42 rad"
    assert (cut in err) == (highest < 0.42)


def test_a_calibration_file_that_cuts_the_range_is_one_line_of_degraded(pi: Bench) -> None:
    folder = CalibrationFolder(pi.folder / "state" / "virtual-pi")
    now = datetime.datetime.now().astimezone()
    saved, _ = folder.save(ServoCalibration(trim=-500.0, scale=2000.0), now)
    with pi.daemon() as daemon:
        with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
            status = fish.status()
        (line,) = (line for line in status.limitations if "servo" in line)
        assert line == (
            f"the servo's calibration of {saved.date} permits -0.25 to +0.42 rad of ±0.42 rad, "
            "amplitude_limit: fishctl calibrate servo"
        )
        assert status.lowest_angle == pytest.approx(-0.25)
        assert calibrations(daemon).servo.trim == -500.0
        _, _, err = daemon.end()
    assert err.count(line) == 1


def test_config_check_reports_a_reduced_range(tmp_path: Path) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text("robot: pi\nservo: {lowest: -0.25}\n")
    ended = fishctl("config", "check", str(file))
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == (
        f"{file}: good\n"
        "servo.lowest and servo.highest permit -0.25 to +0.42 rad of ±0.42 rad, amplitude_limit\n"
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["servo.scale=3000"],
            "servo.scale: 3000 is not valid: angles from -0.42 to +0.42 rad would need pulses of "
            "240 to 2760 µs, beyond 500 to 2500 µs; at most 2380 µs/rad is needed, or an "
            "amplitude_limit of at most 0.333 rad",
        ),
        (
            ["servo.centre=2300"],
            "servo.centre: 2300 is not valid: angles from -0.42 to +0.42 rad would need pulses of "
            "2048 to 2552 µs, beyond 500 to 2500 µs; centre + trim from 752 to 2248 µs is needed, "
            "or an amplitude_limit of at most 0.333 rad",
        ),
        (["servo.centre=1000", "servo.trim=-400"], "servo.trim: -400 is not valid: "),
        (["servo.centre=2300", "servo.direction=-1"], "servo.centre: 2300 is not valid: "),
    ],
)
def test_pulses_that_end_too_early_are_refused(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(None, overrides)
    assert message in str(refusal.value)


@pytest.mark.parametrize(
    "remedy", ["amplitude_limit=0.333", "servo.highest=0.333", "servo.trim=-52"]
)
def test_each_remedy_for_pulses_that_end_too_early_works(remedy: str) -> None:
    config = load(None, ["servo.centre=2300", remedy])
    wanted = min(config.amplitude_limit, config.servo.highest)
    assert pulses.reach(config.servo)[1] >= wanted - pulses.ANGLE_TOLERANCE_RAD


def test_a_limit_that_is_off_by_rounding_cuts_nothing() -> None:
    assert pulses.format_reach(ServoSettings(highest=0.42 - 1e-12), 0.42) is None
    reach = pulses.format_reach(ServoSettings(highest=0.41), 0.42)
    assert reach == "-0.42 to +0.41 rad of ±0.42 rad"
