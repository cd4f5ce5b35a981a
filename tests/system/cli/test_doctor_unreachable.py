"""`fishctl doctor` without permissions, and beside a fishd that it cannot ask."""

import signal
import socket
from pathlib import Path

import pytest
from rigs.doctor_process import doctor, free_telemetry
from rigs.doctor_tree import unprivileged
from rigs.operator_rig import Bench

from fishd.cli.doctor import examine
from fishd.cli.doctor.base import Context
from fishd.config import load

HARDWARE = ("adc", "force", "pwm", "gpio pins")
AS_FISHD = "sudo -u fishd fishctl doctor"


def run_checks(root: Path, endpoint: str, *overrides: str) -> dict[str, tuple[str, str, str]]:
    settings = ["robot=pi", "servo.driver=sysfs-pwm", "telemetry.address=tcp://127.0.0.1:0"]
    (root / "sys/kernel/debug").mkdir(parents=True, exist_ok=True)
    (root / "sys/kernel/debug/gpio").write_text("gpiochip0: GPIOs 512-565\n")
    context = Context(load(None, [*settings, *overrides]), None, endpoint, root)
    list(examine(Context(load(None, settings), None, f"ipc://{root}/nothing", root)))  # imports
    with unprivileged():
        return dict(examine(context))


@pytest.mark.usefixtures("hurried_doctor")
def test_beside_a_fishd_that_hangs_no_hardware_is_touched(pi: Bench) -> None:
    with pi.daemon() as daemon:
        daemon.stop()
        try:
            status, findings = doctor(pi.folder, *pi.settings)
        finally:
            daemon.process.send_signal(signal.SIGCONT)
        assert status == 1
        assert findings["adc"] == findings["force"]
        assert findings["adc"][0] == "skipped"
        assert f"no answer from {daemon.endpoint}" in findings["adc"][1]
        assert f"'fishctl estop --endpoint {daemon.endpoint}' ends" in findings["adc"][1]
        assert findings["daemon"][0] == "FAIL"
        assert f"process {daemon.pid}, a fishd, does not answer" in findings["daemon"][1]
        assert daemon.fishctl("status").returncode == 0  # its socket is still there


def test_beside_a_fishd_that_may_not_be_asked_no_hardware_is_touched(root: Path) -> None:
    path = root / "control"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()
        path.chmod(0)
        findings = run_checks(root, f"ipc://{path}", f"state_folder={root}/state")
    assert path.is_socket()
    for name in HARDWARE:
        level, message, _ = findings[name]
        assert (level, name) == ("skipped", name)
        assert "may not ask" in message
        assert AS_FISHD in message
    assert findings["daemon"][0] == "warning"
    assert findings["daemon"][2].startswith(AS_FISHD)


def test_a_socket_in_a_folder_that_may_not_be_entered_may_be_that_of_a_fishd(root: Path) -> None:
    (root / "locked").mkdir(mode=0)
    findings = run_checks(root, f"ipc://{root}/locked/control", f"state_folder={root}/state")
    assert {findings[name][0] for name in HARDWARE} == {"skipped"}


@pytest.mark.parametrize("scheme", ["ipc", "tcp"])
def test_the_socket_of_a_killed_daemon_is_not_a_daemon(tmp_path: Path, scheme: str) -> None:
    if scheme == "ipc":
        with socket.socket(socket.AF_UNIX) as stale:
            stale.bind(str(tmp_path / "old"))
        endpoint = f"ipc://{tmp_path}/old"
        tmp_path.chmod(0o777)
        _, findings = doctor(tmp_path, "--endpoint", endpoint, *free_telemetry())
    else:
        with socket.socket() as port:  # no program listens there, and none can start to
            port.bind(("127.0.0.1", 0))
            endpoint = f"tcp://127.0.0.1:{port.getsockname()[1]}"
            _, findings = doctor(tmp_path, "--endpoint", endpoint, *free_telemetry())
    if scheme == "ipc":
        assert findings["control"][0] == "warning"
        assert "every user of this machine may replace ipc://" in findings["control"][1]
    level, message = findings["daemon"]
    # Other tests may run a fishd now.
    assert (level, message) == ("ok", "no fishd is running") or message.startswith(
        f"no fishd at {endpoint}, but the fishd of process "
    )


@pytest.mark.usefixtures("hurried_doctor")
def test_a_program_that_does_not_answer_is_reported(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        endpoint = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        _, findings = doctor(tmp_path, "--endpoint", endpoint, *free_telemetry())
    assert findings["daemon"][0] == "warning"
    assert endpoint in findings["daemon"][1]


def test_a_state_folder_without_permission_names_the_user_to_run_as(root: Path) -> None:
    (root / "locked").mkdir(mode=0)
    findings = run_checks(root, f"ipc://{root}/nothing", f"state_folder={root}/locked/state")
    assert findings["state folder"][0] == "FAIL"
    assert findings["calibrations"][0] == "warning"
    for name in ("state folder", "calibrations"):
        assert AS_FISHD in findings[name][2]
    assert findings["disk"][0] in ("ok", "warning")
    broken = {name for name, (_, message, _) in findings.items() if "broke off" in message}
    assert broken <= {"real time"}  # its Python cannot be started by this user


def test_a_state_folder_below_a_file_fails(root: Path) -> None:
    (root / "file").write_text("")
    findings = run_checks(root, f"ipc://{root}/nothing", f"state_folder={root}/file/state")
    for name in ("state folder", "calibrations"):
        level, message, mend = findings[name]
        assert (level, name) == ("FAIL", name)
        assert str(root / "file") in message
        assert "state" in mend
