"""`fishctl release` without a daemon: on pigpiod, on the kernel's PWM, and with nothing to do."""

import datetime
import os
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pigpio
import pytest
from rigs.operator_rig import Bench
from rigs.pigpiod_client import dispose
from rigs.processes import FISHCTL, call, fishctl

from fishd.core.calibration import ServoCalibration
from fishd.hardware.calibration_files import CalibrationFolder


@pytest.fixture
def other_program(pi: Bench) -> Iterator[pigpio.pi]:
    """Client of a program that has left pulses on."""
    client = pigpio.pi("127.0.0.1", pi.pi.port(), show_errors=False)
    client.set_servo_pulsewidth(18, 1750)
    pi.wait_for_pulse(1750, 1750)
    yield client
    dispose(client)


def release(*settings: str, **env: str) -> subprocess.CompletedProcess[str]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in env.items():
            patch.setenv(name, value)
        return fishctl("release", *settings)


def test_a_simulated_fish_that_a_file_names_has_nothing_to_release(tmp_path: Path) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text("robot: simulated\n")
    service = {"SERVICE_RESULT": "success", "FISHD_CONFIG": "/nowhere/fishd.yaml"}
    ended = release("--config", str(file), **service)
    assert (ended.returncode, ended.stderr) == (0, "")
    ended_well = "the service ended with 'success': a simulated fish"
    assert ended.stdout == f"{ended_well}, by {file}, has nothing to release\n"


def test_without_any_file_it_is_no_success_and_says_how_to_name_one() -> None:
    ended = release()
    assert (ended.returncode, ended.stdout) == (1, "")
    assert re.fullmatch(r"fishctl: nothing was released: [^\n]+ --config FILE\n", ended.stderr)
    assert "/etc/fishd/fishd.yaml" in ended.stderr


def test_the_file_of_the_service_is_used_by_default(pi: Bench, other_program: pigpio.pi) -> None:
    file = pi.folder / "service.yaml"
    file.write_text("robot: virtual-pi\n")
    ended = release(*pi.settings[2:], FISHD_CONFIG=str(file))
    assert (ended.returncode, ended.stdout) == (0, "pulses were on: neutral, then off\n")
    assert ended.stderr == f"fishctl: using {file}; --config names another file\n"
    assert pi.pi.widths()[-3:] == [1750, 1500, 0]


def test_a_failed_output_is_no_failure_of_a_release(pi: Bench, other_program: pigpio.pi) -> None:
    command = ["sh", "-c", '"$@" >/dev/full', "sh", FISHCTL, "release", *pi.settings]
    ended = call(*command, env=os.environ | {"FISHD_CONFIG": ""})
    problem = "the output cannot be written: No space left on device"
    message = f"pulses were on: neutral, then off; {problem}"
    assert (ended.returncode, ended.stderr) == (0, f"fishctl: {message}\n")
    assert pi.pi.widths()[-3:] == [1750, 1500, 0]


def test_a_file_of_the_service_that_is_not_there_is_exit_status_78() -> None:
    ended = release(FISHD_CONFIG="/nowhere/fishd.yaml")
    assert ended.returncode == 78
    assert "/nowhere/fishd.yaml: no such file" in ended.stderr


def test_a_fishd_that_drives_the_servo_is_asked_for_an_emergency_stop(pi: Bench) -> None:
    with pi.daemon() as daemon:
        daemon.fishctl("set-controller", "hold", "--angle", "0.2")
        pi.wait_for_pulse(1600, 1700)
        ended = release(*pi.settings, "--set", f"control.address={daemon.endpoint}")
        assert (ended.returncode, ended.stderr) == (0, "")
        pid = daemon.process.pid
        assert ended.stdout == f"fishd (pid {pid}) was asked: mode estop, there are no pulses\n"
        pi.wait_for_pulse(0, 0)  # at the end of the pulse that has begun
        assert daemon.status().mode == "estop"
        assert daemon.status().recovered_errors["servo_reconnects"] == 0


def test_a_fishd_that_does_not_answer_where_it_should_be_is_named(pi: Bench) -> None:
    with pi.daemon() as daemon:
        daemon.fishctl("set-controller", "hold", "--angle", "0.2")
        pi.wait_for_pulse(1600, 1700)
        ended = release(*pi.settings, "--set", f"control.address=ipc://{pi.folder}/elsewhere")
        assert ended.returncode == 0
        assert ended.stdout == (
            f"fishd (pid {daemon.process.pid}) drives the servo and did not answer at "
            f"ipc://{pi.folder}/elsewhere: pulses were on: neutral, then off\n"
        )
        assert pi.pi.pulse() == 0


@pytest.mark.parametrize("restarted", [False, True])
def test_pulses_of_the_pwm_peripheral_unknown_to_pigpiod_end(pi: Bench, restarted: bool) -> None:
    client = pigpio.pi("127.0.0.1", pi.pi.port(), show_errors=False)
    client.hardware_PWM(18, 50, 1740 * 50)
    dispose(client)
    if restarted:
        pi.pi.inject("pigpiod-restart")
    pi.wait_for_pulse(1739, 1741)
    ended = release(*pi.settings)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == "pulses were on: neutral, then off\n"
    assert pi.pi.widths()[-2:] == [1500, 0]
    before = pi.pi.widths()
    assert release(*pi.settings).stdout == "there were no pulses\n"
    assert pi.pi.widths() == before


def test_neutral_is_that_of_the_calibration(pi: Bench, other_program: pigpio.pi) -> None:
    folder = CalibrationFolder(pi.folder / "state" / "virtual-pi")
    folder.save(ServoCalibration(trim=-40.0), datetime.datetime.now().astimezone())
    assert release(*pi.settings).returncode == 0
    assert pi.pi.widths()[-3:] == [1750, 1460, 0]


@pytest.mark.parametrize(
    "broken", ["state/virtual-pi/servo-2026-01-01T000000.000000Z.yaml", "state"]
)
def test_a_calibration_that_cannot_be_read_does_not_keep_the_servo_energised(
    pi: Bench, other_program: pigpio.pi, broken: str
) -> None:
    path = pi.folder / broken
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("trim: straight\n")
    ended = release(*pi.settings)
    assert (ended.returncode, ended.stdout) == (0, "pulses were on: neutral, then off\n")
    assert re.fullmatch(rf"fishctl: [^\n]+/{broken}[^\n]+; going on without it\n", ended.stderr)
    assert pi.pi.widths()[-3:] == [1750, 1500, 0]


@pytest.mark.parametrize("folder", ["~no-user/fish", '"/var/\\0fish"', "3"])
def test_a_state_folder_that_cannot_be_does_not_keep_the_servo_energised(
    pi: Bench, other_program: pigpio.pi, folder: str
) -> None:
    ended = release(*pi.settings, "--set", f"state_folder={folder}")
    assert (ended.returncode, ended.stdout) == (0, "pulses were on: neutral, then off\n")
    assert re.fullmatch(r"fishctl: --set .*: state_folder: .*; going on without it\n", ended.stderr)
    assert pi.pi.widths()[-3:] == [1750, 1500, 0]


def test_a_state_folder_that_cannot_be_hides_no_other_fault() -> None:
    ended = release("--set", "robot=pi", "--set", "state_folder=~no-user", "--set", "tick=soon")
    assert (ended.returncode, ended.stdout) == (78, "")
    assert re.fullmatch(r"fishctl: [^\n]*tick: 'soon' is not valid[^\n]*\n", ended.stderr)


@pytest.mark.realtime
@pytest.mark.parametrize("fault", ["pigpiod-frozen", "pigpiod-gone"])
def test_a_pigpiod_that_does_not_answer_is_one_line_and_no_long_wait(pi: Bench, fault: str) -> None:
    pi.pi.inject(fault)
    began = time.monotonic()
    ended = release(*pi.settings)
    assert time.monotonic() - began < 5.0
    assert (ended.returncode, ended.stdout) == (1, "")
    assert re.fullmatch(r"fishctl: pigpiod at 127.0.0.1:\d+: [^\n]+\n", ended.stderr)
