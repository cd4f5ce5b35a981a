"""`fishctl release` without a daemon: on pigpiod, on the kernel's PWM, where nothing is to do."""

import datetime
import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pigpio
import pytest
from operator_rig import Bench
from processes import FISHCTL, PATIENCE

from fishd.hardware.calibration import ServoCalibration
from fishd.hardware.calibration_files import CalibrationFolder


@pytest.fixture
def other_program(pi: Bench) -> Iterator[pigpio.pi]:
    """Something that has left pulses on."""
    client = pigpio.pi("127.0.0.1", pi.pi.port(), show_errors=False)
    client.set_servo_pulsewidth(18, 1750)
    pi.wait_for_pulse(1750, 1750)
    yield client
    client.stop()


def release(*settings: str, **env: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [FISHCTL, "release", *settings],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE,
        env=os.environ | env,
    )


@pytest.fixture
def simulated(tmp_path: Path) -> Path:
    file = tmp_path / "fish.yaml"
    file.write_text("robot: simulated\n")
    return file


def test_a_simulated_fish_that_a_file_names_has_nothing_to_release(simulated: Path) -> None:
    ended = release("--config", str(simulated), SERVICE_RESULT="success")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == (
        f"the service ended with 'success': a simulated fish, by {simulated}, has nothing to "
        "release\n"
    )


def test_without_any_file_it_is_no_success_and_says_how_to_name_one() -> None:
    ended = release()
    assert (ended.returncode, ended.stdout) == (1, "")
    assert re.fullmatch(r"fishctl: nothing was released: [^\n]+ --config FILE\n", ended.stderr)
    assert "/etc/fishd/fishd.yaml" in ended.stderr


def test_the_file_of_the_service_is_used_where_none_is_named(
    pi: Bench, other_program: pigpio.pi
) -> None:
    file = pi.folder / "service.yaml"
    file.write_text("robot: virtual-pi\n")
    ended = release(*pi.settings[2:], FISHD_CONFIG=str(file))
    assert (ended.returncode, ended.stdout) == (0, "pulses were on: neutral, then off\n")
    assert ended.stderr == f"fishctl: using {file}; --config names another file\n"


def test_a_file_that_is_named_comes_before_that_of_the_service(simulated: Path) -> None:
    ended = release("--config", str(simulated), FISHD_CONFIG="/nowhere/fishd.yaml")
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_file_of_the_service_that_is_not_there_is_exit_status_78() -> None:
    ended = release(FISHD_CONFIG="/nowhere/fishd.yaml")
    assert ended.returncode == 78
    assert "/nowhere/fishd.yaml: no such file" in ended.stderr


def test_the_last_resort_works_while_a_fishd_hangs(pi: Bench) -> None:
    with pi.daemon() as daemon:
        daemon.fishctl("set-controller", "hold", "--angle", "0.2")
        daemon.process.send_signal(signal.SIGSTOP)
        try:
            ended = release(*pi.settings)
        finally:
            daemon.process.send_signal(signal.SIGCONT)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_pulses_that_were_left_on_end_at_neutral(pi: Bench, other_program: pigpio.pi) -> None:
    ended = release(*pi.settings)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == "pulses were on: neutral, then off\n"
    assert pi.pi.widths()[-3:] == [1750, 1500, 0]


@pytest.mark.parametrize("restarted", [False, True])
def test_pulses_of_the_pwm_peripheral_that_pigpiod_may_not_know_of_end_too(
    pi: Bench, restarted: bool
) -> None:
    client = pigpio.pi("127.0.0.1", pi.pi.port(), show_errors=False)
    client.hardware_PWM(18, 50, 1740 * 50)
    client.stop()
    if restarted:
        pi.pi.inject("pigpiod-restart")
    pi.wait_for_pulse(1739, 1741)
    ended = release(*pi.settings)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout == "pulses were on: neutral, then off\n"
    assert pi.pi.widths()[-2:] == [1500, 0]
    assert release(*pi.settings).stdout == "there were no pulses\n"


def test_a_servo_without_pulses_is_left_alone(pi: Bench) -> None:
    before = pi.pi.widths()
    ended = release(*pi.settings)
    assert (ended.returncode, ended.stdout) == (0, "there were no pulses\n")
    assert pi.pi.widths() == before


def test_systemds_reason_is_in_the_line(pi: Bench) -> None:
    ended = release(*pi.settings, SERVICE_RESULT="watchdog")
    assert ended.stdout == "the service ended with 'watchdog': there were no pulses\n"


def test_neutral_is_that_of_the_calibration(pi: Bench, other_program: pigpio.pi) -> None:
    folder = CalibrationFolder(pi.folder / "state" / "virtual-pi")
    folder.save(ServoCalibration(trim=-40.0), datetime.datetime.now().astimezone())
    assert release(*pi.settings).returncode == 0
    assert pi.pi.widths()[-3:] == [1750, 1460, 0]


def test_a_broken_calibration_does_not_keep_the_servo_energised(
    pi: Bench, other_program: pigpio.pi
) -> None:
    folder = pi.folder / "state" / "virtual-pi"
    folder.mkdir(parents=True)
    (folder / "servo-2026-01-01T000000.000000Z.yaml").write_text("trim: straight\n")
    ended = release(*pi.settings)
    assert (ended.returncode, ended.stdout) == (0, "pulses were on: neutral, then off\n")
    assert re.fullmatch(r"fishctl: [^\n]+/servo-2026[^\n]+; going on without it\n", ended.stderr)
    assert pi.pi.widths()[-1] == 0


def test_an_unreadable_state_folder_does_not_keep_the_servo_energised(
    pi: Bench, other_program: pigpio.pi
) -> None:
    (pi.folder / "file").write_text("")
    ended = release(*pi.settings, "--set", f"state_folder={pi.folder}/file/state")
    assert (ended.returncode, ended.stdout) == (0, "pulses were on: neutral, then off\n")
    assert re.fullmatch(r"fishctl: [^\n]+/file/state[^\n]+; going on without it\n", ended.stderr)
    assert pi.pi.widths()[-3:] == [1750, 1500, 0]


@pytest.mark.parametrize("fault", ["pigpiod-frozen", "pigpiod-gone"])
def test_a_pigpiod_that_does_not_answer_is_one_line_and_no_long_wait(pi: Bench, fault: str) -> None:
    pi.pi.inject(fault)
    began = time.monotonic()
    ended = release(*pi.settings)
    assert time.monotonic() - began < 5.0
    assert (ended.returncode, ended.stdout) == (1, "")
    assert re.fullmatch(r"fishctl: pigpiod at 127.0.0.1:\d+: [^\n]+\n", ended.stderr)


def test_a_wrong_configuration_is_one_line_and_exit_status_78() -> None:
    ended = release("--set", "servo.driver=steam")
    assert (ended.returncode, ended.stdout) == (78, "")
    assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize("enabled", [True, False])
def test_the_kernels_pwm_is_released_too(tmp_path: Path, enabled: bool) -> None:
    channel = tmp_path / "pwm" / "pwmchip3" / "pwm2"
    channel.mkdir(parents=True)
    device = tmp_path / "devices" / "1f00098000.pwm"
    device.mkdir(parents=True)
    (channel.parent / "device").symlink_to(device)
    for name, value in (("period", 20_000_000), ("duty_cycle", 1_800_000), ("enable", enabled)):
        (channel / name).write_text(f"{int(value)}\n")
    ended = release(
        *("--set", "robot=pi", "--set", "servo.driver=sysfs-pwm"),
        *("--set", f"servo.sysfs.root={tmp_path / 'pwm'}"),
        *("--set", f"state_folder={tmp_path}"),
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("pulses were on" if enabled else "there were no pulses")
    duty, on = ((channel / name).read_text().split()[0] for name in ("duty_cycle", "enable"))
    assert (int(duty), int(on)) == ((0, 0) if enabled else (1_800_000, 0))


def test_without_a_pwm_chip_it_says_which_overlay_is_missing(tmp_path: Path) -> None:
    ended = release(
        *("--set", "robot=pi", "--set", "servo.driver=sysfs-pwm"),
        *("--set", f"servo.sysfs.root={tmp_path}", "--set", f"state_folder={tmp_path}"),
    )
    assert (ended.returncode, ended.stdout) == (1, "")
    assert re.fullmatch(r"fishctl: [^\n]*overlay[^\n]*\n", ended.stderr)
