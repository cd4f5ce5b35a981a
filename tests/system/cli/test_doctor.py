"""`fishctl doctor` as a user meets it: on real processes, a virtual Pi and a broken one."""

import datetime
import os
import socket
from pathlib import Path
from typing import Any

import pytest
from rigs.doctor_process import doctor, free_telemetry
from rigs.operator_rig import Bench, bench
from rigs.processes import fishctl

from fishd.core.calibration import ForceCalibration
from fishd.hardware.calibration_files import CalibrationFolder

GOOD_LEVELS = ("ok", "warning")
"""Levels of timed checks: a busy machine may give fewer samples than a healthy bus."""


def test_on_a_simulated_robot_only_what_it_needs_is_checked(tmp_path: Path) -> None:
    status, findings = doctor(tmp_path, *free_telemetry())
    assert status == 0
    assert {"configuration", "packages", "disk", "daemon"} <= findings.keys()
    assert not {"adc", "force", "pigpiod", "i2c bus", "calibrations"} & findings.keys()
    ended = fishctl("--endpoint", f"ipc://{tmp_path}/control", "doctor", *free_telemetry())
    assert ended.stdout.endswith("\na simulated fish needs no hardware, so none was checked\n")


def test_the_table_has_a_line_for_each_check_and_says_how_to_mend(pi: Bench) -> None:
    ended = fishctl("doctor", *pi.settings, *free_telemetry(), "--endpoint", "ipc:///nowhere")
    assert (ended.returncode, ended.stderr) == (0, "")
    lines = ended.stdout.splitlines()
    assert (
        "ok       adc            an ADS1115 answers at 0x48 on /dev/i2c-1, as after power-on"
        in lines
    )
    warned = lines.index(next(line for line in lines if line.startswith("warning  calibrations")))
    assert lines[warned + 1].strip() == "fishctl calibrate force"
    warnings = sum(line.startswith("warning ") for line in lines)
    noun = "warning" if warnings == 1 else "warnings"
    assert f", {warnings} {noun}, 0 failed, 0 skipped" in lines[-1]


def test_a_healthy_virtual_pi_is_all_well_with_and_without_a_daemon(pi: Bench) -> None:
    status, alone = doctor(pi.folder, *pi.settings, *free_telemetry())
    assert status == 0
    assert alone["adc"][0] == "ok"
    assert alone["force"][0] in GOOD_LEVELS
    assert alone["pigpiod"][0] in GOOD_LEVELS
    assert "not clipped, not frozen" in alone["force"][1]
    with pi.daemon() as daemon:
        status, asked = doctor(pi.folder, *pi.settings, *free_telemetry())
        assert status == 0
        assert asked["adc"][0] == "skipped"
        assert asked["force"][0] in GOOD_LEVELS
        assert "the newest" in asked["force"][1]
        assert str(daemon.process.pid) in asked["daemon"][1]
        assert asked["control"] == ("ok", f"{daemon.endpoint} is served by the running fishd")
        assert daemon.fishctl("status", "--json").stdout.count('"idle"') == 1
    _, after = doctor(pi.folder, *pi.settings, *free_telemetry())
    assert after["adc"][1].endswith("as fishd left it")


def test_the_force_is_judged_by_the_calibration_that_fishd_would_use(pi: Bench) -> None:
    settings = (*pi.settings, "--set", "force_sensor.force_limit=1e-4", *free_telemetry())
    _, findings = doctor(pi.folder, *settings)
    assert "suspect in" in findings["force"][1]
    assert "(not calibrated: 1 V counts as 1 N)" in findings["force"][1]
    folder = CalibrationFolder(pi.folder / "state" / "virtual-pi")
    folder.save(ForceCalibration(xx=1e-6, yy=1e-6, loads=5), datetime.datetime.now(datetime.UTC))
    _, findings = doctor(pi.folder, *settings)
    assert "not clipped, not frozen" in findings["force"][1]


@pytest.mark.parametrize(
    ("fault", "check", "complaint"),
    [
        ("unplugged", "adc", "nothing answers at 0x48"),
        ("unplugged", "force", "nothing answers at 0x48"),
        ("bus-owned", "adc", "a kernel driver owns 0x48"),
        ("timeout", "adc", "/dev/i2c-1 hangs"),
        ("frozen-code", "force", "suspect"),
        ("clipped", "force", "suspect"),
        ("stuck-busy", "force", "switch its power off and on"),
        ("pigpiod-gone", "pigpiod", "Connection refused"),
        ("pigpiod-frozen", "pigpiod", "no answer within"),
    ],
)
def test_a_fault_of_the_hardware_fails_the_check_that_is_about_it(
    pi: Bench, fault: str, check: str, complaint: str
) -> None:
    pi.pi.inject(fault)
    quick = ("--set", "force_sensor.frozen_after=0.2") if fault == "frozen-code" else ()
    status, findings = doctor(pi.folder, *pi.settings, *quick, *free_telemetry())
    level, message = findings[check]
    assert (status, level) == (1, "FAIL")
    assert complaint in message
    sound = {"adc", "force", "pigpiod"} - {check}
    if fault.startswith("pigpiod"):
        assert all(findings[name][0] in GOOD_LEVELS for name in sound)
    else:
        assert findings["pigpiod"][0] in GOOD_LEVELS


@pytest.mark.parametrize(
    ("register", "value", "level", "complaint"),
    [(1, 0x0483, "warning", "another program uses it"), (3, 0x7FF0, "warning", "threshold 0x7ff0")],
)
def test_a_chip_that_is_not_as_fishd_left_it_is_pointed_out(
    pi: Bench, register: int, value: int, level: str, complaint: str
) -> None:
    pi.pi.write_register(register, value)
    _, findings = doctor(pi.folder, *pi.settings, *free_telemetry())
    assert findings["adc"][0] == level
    assert complaint in findings["adc"][1]


def test_an_ads1015_sold_as_ads1115_fails_whether_fishd_runs_or_not(
    process: Any, tmp_path: Path
) -> None:
    with bench(process, tmp_path, 12) as pi:
        findings = [doctor(tmp_path, *pi.settings, *free_telemetry())[1]["adc"]]
        pi.pi.write_register(3, 0x123F)  # by another program, which believes the label too
        findings.append(doctor(tmp_path, *pi.settings, *free_telemetry())[1]["adc"])
        with pi.daemon("--set", "force_sensor.frozen_after=null") as daemon:
            _, asked = doctor(tmp_path, *pi.settings, *free_telemetry())
            (limitation,) = (line for line in daemon.status().limitations if "ADS1015" in line)
            assert limitation in daemon.fishctl("status").stdout
    assert [*findings, asked["adc"]] == 3 * [("FAIL", limitation)]
    assert limitation in asked["daemon"][1]


def test_without_a_virtual_pi_the_sensor_fails_in_one_line(tmp_path: Path) -> None:
    settings = ("--set", "robot=virtual-pi", "--set", f"virtual_pi.socket={tmp_path}/nothing")
    status, findings = doctor(tmp_path, *settings, *free_telemetry())
    assert status == 1
    assert "no virtual Pi is running" in findings["adc"][1]
    assert "no virtual Pi is running" in findings["force"][1]


def test_a_daemon_in_fault_fails_with_its_reason(pi: Bench) -> None:
    with pi.daemon() as daemon:
        pi.pi.inject("unplugged")
        while '"fault"' not in daemon.fishctl("status", "--json").stdout:
            pass
        status, findings = doctor(pi.folder, *pi.settings)
    assert status == 1
    assert findings["daemon"][0] == findings["force"][0] == "FAIL"
    assert "sensor-stale" in findings["daemon"][1]


def test_measurements_of_a_fishd_of_another_robot_are_not_used(pi: Bench) -> None:
    with pi.daemon() as daemon:
        settings = ("--set", "robot=pi", "--set", f"state_folder={pi.folder}/of-pi")
        _, findings = doctor(pi.folder, *settings)
    another = f"the fishd at {daemon.endpoint} drives another robot, virtual-pi; name this one's"
    assert findings["adc"] == findings["force"] == ("skipped", f"{another} with --endpoint")
    assert findings["daemon"][0] == "warning"
    assert "robot virtual-pi" in findings["daemon"][1]
    assert f"{pi.folder}/of-pi" in findings["state folder"][1]
    assert findings["control"][0] == "ok"


def test_an_address_that_is_taken_fails(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, findings = doctor(tmp_path, "--set", f"telemetry.address=tcp://127.0.0.1:{port}")
    assert status == 1
    assert findings["telemetry"][0] == "FAIL"
    assert "in use" in findings["telemetry"][1]


def test_missing_privileges_are_warnings(tmp_path: Path) -> None:
    unprivileged = ("prlimit", "--memlock=65536", "--rtprio=0")
    if os.geteuid() == 0:
        unprivileged += (
            *("setpriv", "--bounding-set=-sys_nice,-ipc_lock,-sys_resource"),
            "--inh-caps=-sys_nice,-ipc_lock,-sys_resource",
        )
    status, findings = doctor(tmp_path, *free_telemetry(), under=unprivileged)
    assert status == 0
    assert findings["real time"][0] == findings["memory"][0] == "warning"
    modest = ("--set", "realtime.priority=0", "--set", "realtime.lock_memory=false")
    _, findings = doctor(tmp_path, *free_telemetry(), *modest, under=unprivileged)
    assert findings["real time"][0] == findings["memory"][0] == "ok"


def install(folder: Path, name: str, version: str) -> dict[str, str]:
    """Return the environment in which a package seems installed; only its metadata exists."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    return {"PYTHONPATH": str(folder)}


def test_both_packages_for_gpio_pins_together_fail(tmp_path: Path) -> None:
    env = install(tmp_path, "RPi.GPIO", "0.7.1")
    install(tmp_path, "rpi-lgpio", "0.6")
    status, findings = doctor(tmp_path, "--set", "robot=pi", *free_telemetry(), **env)
    assert status == 1
    assert findings["gpio package"][0] == "FAIL"
    assert "both installed" in findings["gpio package"][1]


def test_a_driver_that_is_too_old_fails_only_where_it_is_needed(tmp_path: Path) -> None:
    env = install(tmp_path, "adafruit-circuitpython-ads1x15", "3.0.4")
    status, findings = doctor(tmp_path, "--set", "robot=pi", *free_telemetry(), **env)
    assert status == 1
    needed = "adafruit-circuitpython-ads1x15 is 3.0.4, >= 3.0.5 is needed"
    assert findings["packages"] == ("FAIL", needed)
    status, findings = doctor(tmp_path, *free_telemetry(), **env)
    assert (status, findings["packages"][0]) == (0, "ok")


def test_a_configuration_that_anybody_may_change_is_a_warning(tmp_path: Path) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text("tick: 0.05\n")
    for mode, level in ((0o644, "ok"), (0o666, "warning")):
        file.chmod(mode)
        _, findings = doctor(tmp_path, "--config", str(file), *free_telemetry())
        assert findings["configuration"][0] == level
