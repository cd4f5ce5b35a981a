"""One fishd for one robot: a second one of any user is refused until the first has ended."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.doctor_process import doctor, free_telemetry
from rigs.operator_rig import Bench
from rigs.other_user import command_as_user
from rigs.processes import Daemon, running, sets
from rigs.spare_bus import ANOTHER, spare_bus

from fishd.core.errors import StartupError
from fishd.core.process import kernel_names
from fishd.hardware import ownership


@pytest.fixture
def folders() -> Iterator[tuple[Path, Path]]:
    """Two folders that every user may write to."""
    parent = Path(tempfile.mkdtemp())
    for folder in (parent, parent / "one", parent / "other"):
        folder.mkdir(exist_ok=True)
        folder.chmod(0o777)
    yield parent / "one", parent / "other"
    shutil.rmtree(parent)


def failed_start(folder: Path, *arguments: str, **command: tuple[str, ...]) -> str:
    """Return the message of a fishd that does not start."""
    status, _, err = Daemon(folder, *arguments, **command).finish()
    assert status == 1
    assert err.count("\n") == 1
    return err


def pi_settings(folder: Path) -> list[str]:
    bus = spare_bus()
    hardware = f"force_sensor.bus={bus}", "servo.host=127.0.0.2", f"servo.port={20000 + bus}"
    return sets("robot=pi", *hardware, f"state_folder={folder}")


def test_a_second_fishd_on_the_same_bus_is_refused_with_a_pid(folders: tuple[Path, Path]) -> None:
    one, other = folders
    with running(one, *pi_settings(one)) as first:
        message = failed_start(other, *pi_settings(other))
        assert f"another fishd (pid {first.process.pid}) drives /dev/i2c-{spare_bus()}; " in message
        assert "force_sensor.bus" in message
        elsewhere = [*pi_settings(other), "--set", f"force_sensor.bus={spare_bus() + ANOTHER}"]
        message = failed_start(other, *elsewhere)
        assert f"another fishd (pid {first.process.pid}) drives the servo on GPIO 18" in message
        assert first.fishctl("status").returncode == 0


def test_fishds_of_two_users_in_two_environments_share_no_servo(
    folders: tuple[Path, Path],
) -> None:
    nobody = command_as_user(65534)
    one, other = folders
    start = ("-m", "fishd")
    private = ("sh", "-c", 'umask 077; unset XDG_RUNTIME_DIR; exec "$@"', "sh", *nobody)
    with running(one, *pi_settings(one), under=private, start=start) as first:
        message = failed_start(other, *pi_settings(other))
        assert f"another fishd (pid {first.process.pid} of user 65534) drives /dev/i2c-" in message
        first.kill()
    with running(other, *pi_settings(other)) as first:
        message = failed_start(one, *pi_settings(one), under=nobody, start=start)
        assert f"another fishd (pid {first.process.pid} of user 0) drives" in message


def test_a_folder_that_vanishes_takes_no_lock_with_it(tmp_path: Path) -> None:
    runtime = tmp_path / "runtime"
    runtime.mkdir()
    (tmp_path / "other").mkdir()
    login = ("env", f"XDG_RUNTIME_DIR={runtime}")
    cron = ("env", "-u", "XDG_RUNTIME_DIR")
    with running(tmp_path, *pi_settings(tmp_path), under=login) as first:
        shutil.rmtree(runtime)
        for under in (login, cron):
            message = failed_start(tmp_path / "other", *pi_settings(tmp_path), under=under)
            assert f"another fishd (pid {first.process.pid}) drives /dev/i2c-" in message


def test_a_claim_is_held_by_one_process_until_that_is_killed() -> None:
    part = ownership.Part(f"drives/a-part-of-{os.getpid()}", "a part", "a.key")
    holder = (
        "import sys, time\nfrom fishd.core.process.kernel_names import claimed\n"
        "with claimed(sys.argv[1]): print('held', flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", holder, part.name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        assert ownership.find_owner([part]) == (process.pid, os.geteuid())
        assert ownership.describe_owner([part]) == f"a fishd (pid {process.pid}) drives a part"
        with (
            pytest.raises(StartupError, match=r"give this one another a\.key"),
            ownership.claim_parts([part]),
        ):
            pass
        process.kill()
    with ownership.claim_parts([part]):
        pass
    assert ownership.find_owner([part]) is None


def test_programs_that_ask_for_the_owner_for_ever_neither_hide_it_nor_keep_it_from_starting() -> (
    None
):
    part = ownership.Part(f"drives/asked-{os.getpid()}", "a part", "a.key")
    with ownership.claim_parts([part]):
        for _ in range(10_000):  # more than the kernel queues
            if ownership.find_owner([part]) != (os.getpid(), os.geteuid()):
                break
        assert ownership.find_owner([part]) == (0, -1)
        assert ownership.describe_owner([part]) == "a fishd (pid unknown) drives a part"
        kernel_names.drop_readers()  # as a fishd does twice a second
        assert ownership.find_owner([part]) == (os.getpid(), os.geteuid())
    with ownership.claim_parts([part]):
        pass


def test_one_virtual_pi_takes_one_fishd_by_any_name_of_its_socket_even_one_that_hangs(
    pi: Bench, tmp_path: Path
) -> None:
    (tmp_path / "second").mkdir()
    (tmp_path / "folder").symlink_to(pi.folder)
    (tmp_path / "link").symlink_to(tmp_path / "folder" / "virtual-pi")
    other_name = ["--set", f"virtual_pi.socket={tmp_path}/link"]
    with pi.daemon() as first:
        taken = f"another fishd (pid {first.process.pid}) drives the virtual Pi on "
        assert taken in failed_start(tmp_path / "second", *pi.settings, *other_name)
        first.stop()
        try:
            assert taken in failed_start(tmp_path / "second", *pi.settings)
        finally:
            first.process.send_signal(signal.SIGCONT)
    with running(tmp_path / "second", *pi.settings):  # free again
        pass


def test_doctor_leaves_the_bus_of_another_endpoint_alone(pi: Bench, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    with running(tmp_path / "elsewhere", *pi.settings) as daemon:
        _, findings = doctor(pi.folder, *pi.settings, *free_telemetry())
    for name in ("adc", "force"):
        assert findings[name][0] == "skipped"
        assert f"(pid {daemon.process.pid})" in findings[name][1]
        assert "--endpoint" in findings[name][1]
    level, message = findings["daemon"]
    assert level == "warning"
    assert f"at ipc://{pi.folder}/control, but a fishd (pid {daemon.process.pid})" in message
