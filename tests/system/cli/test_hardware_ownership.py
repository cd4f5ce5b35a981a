"""One fishd for one robot: a second one of any user is refused until the first has ended."""

import fcntl
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
from rigs.processes import FISHD, Daemon, running, sets
from rigs.spare_bus import ANOTHER, spare_bus

from fishd.core.errors import StartupError
from fishd.core.process.lockfile import lock_path
from fishd.hardware import ownership

NOBODY = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups")


@pytest.fixture
def folders() -> Iterator[tuple[Path, Path]]:
    """Two folders that every user may write to; lock files are removed afterwards."""
    parent = Path(tempfile.mkdtemp())
    for folder in (parent, parent / "one", parent / "other"):
        folder.mkdir(exist_ok=True)
        folder.chmod(0o777)
    yield parent / "one", parent / "other"
    shutil.rmtree(parent)
    bus = spare_bus()
    for lock in ownership.lock_folder().glob("fishd-*"):
        if lock.name.startswith((f"fishd-i2c-{bus}.", f"fishd-127.0.0.2:{20000 + bus}-")):
            lock.unlink()


def command_as_nobody() -> tuple[str, ...]:
    """Return the command that starts a fishd as user 65534, if that user can start Python."""
    version = "python{}.{}".format(*sys.version_info)
    for python in (sys.executable, f"/usr/bin/{version}", f"/usr/local/bin/{version}"):
        under = (*NOBODY, "env", f"PYTHONPATH={os.pathsep.join(sys.path[1:])}", python)
        child = "import subprocess, sys; sys.exit(subprocess.call([sys.executable, '--version']))"
        for arguments in (["-c", child], [FISHD, "--version"]):
            if subprocess.run([*under, *arguments], capture_output=True, check=False).returncode:
                break
        else:
            return under
    pytest.skip("another user cannot start this fishd: its folder, or Python's, is private")


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
    (ownership.lock_folder() / f"fishd-i2c-{spare_bus() + ANOTHER}.lock").unlink()


GROUP = 65534
IN_FOLDER = """
import sys
from pathlib import Path
from fishd.hardware import ownership
ownership.FOLDER = Path({folder!r})
from fishd.daemon.main import main
main()
"""


@pytest.fixture
def locks(tmp_path: Path) -> Iterator[Path]:
    """Folder of lock files as made by the Debian package, with the group of user 65534."""
    if os.geteuid() != 0:
        pytest.skip("needs root: one fishd runs as another user")
    parent = Path(tempfile.mkdtemp())
    parent.chmod(0o755)
    folder = parent / "locks"
    folder.mkdir()
    os.chown(folder, 0, GROUP)
    folder.chmod(0o3770)
    yield folder
    shutil.rmtree(parent)


def test_fishd_of_another_user_counts_as_owner(folders: tuple[Path, Path], locks: Path) -> None:
    nobody = command_as_nobody()
    start = ("-c", IN_FOLDER.format(folder=str(locks)))
    own_start = (sys.executable, "-P", *start)
    one, other = folders
    private = ("sh", "-c", 'umask 077; exec "$@"', "sh", *nobody)
    with running(one, *pi_settings(one), under=private, start=start) as killed:
        message = failed_start(other, *pi_settings(other), start=own_start)
        assert f"drives /dev/i2c-{spare_bus()}" in message
        assert {lock.stat().st_mode & 0o777 for lock in locks.iterdir()} == {0o660}
        killed.kill()
    with running(other, *pi_settings(other), start=own_start) as first:  # same lock files
        message = failed_start(one, *pi_settings(one), under=nobody, start=start)
        assert f"(pid {first.process.pid})" in message


def test_a_user_who_may_not_know_the_locks_does_not_start_and_cannot_take_one(
    folders: tuple[Path, Path], locks: Path
) -> None:
    one, other = folders
    outsider = [word.replace("regid=65534", "regid=65533") for word in command_as_nobody()]
    start = ("-c", IN_FOLDER.format(folder=str(locks)))
    own_start = (sys.executable, "-P", *start)
    message = failed_start(one, *pi_settings(one), under=tuple(outsider), start=start)
    assert "Permission denied, so whether another fishd drives " in message
    assert f"join the group of {locks} ('sudo usermod -aG fishd USER')" in message
    with running(other, *pi_settings(other), start=own_start):
        (lock, *_) = sorted(locks.iterdir())
        take = ("-c", "import os, sys; os.open(sys.argv[1], os.O_RDONLY)", str(lock))
        attempt = subprocess.run([*outsider, *take], capture_output=True, text=True, check=False)
    assert "PermissionError" in attempt.stderr


def test_a_folder_of_lock_files_that_another_user_made_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "fishd"
    folder.mkdir()
    folder.chmod(0o777)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(folder))
    part = ownership.Part(folder / "fishd-bus", "/dev/i2c-7", "force_sensor.bus")
    with (
        pytest.raises(StartupError, match=f"other users may write to {folder}"),
        ownership.claim_parts([part]),
    ):
        pass


def test_the_kernel_names_the_holder_of_a_lock_whatever_is_written_into_it(tmp_path: Path) -> None:
    part = ownership.Part(tmp_path / "fishd-bus", "/dev/i2c-7", "force_sensor.bus")
    with ownership.claim_parts([part]):
        lock_path(part.path).write_text("1\n")
        assert ownership.find_owner_pid([part]) == str(os.getpid())


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


def test_without_a_place_for_lock_files_fishd_says_so_and_starts(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    part = ownership.Part(tmp_path / "nowhere" / "bus", "/dev/i2c-7", "force_sensor.bus")
    with ownership.claim_parts([part]):
        assert "nothing keeps a second fishd from driving /dev/i2c-7" in caplog.text
    assert ownership.describe_owner([part]) == ""


def test_a_symbolic_link_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "bus.lock").symlink_to(victim)
    with ownership.claim_parts([ownership.Part(tmp_path / "bus", "a bus", "force_sensor.bus")]):
        pass
    assert victim.read_text() == "precious"


def test_a_program_that_only_asks_for_the_owner_keeps_no_fishd_from_starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = ownership.Part(tmp_path / "fishd-part", "a part", "a.key")
    slept: list[float] = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        if sum(slept) > 0.5:  # the claim has waited by then
            reader.close()

    monkeypatch.setattr("time.sleep", sleep)
    with lock_path(part.path).open("w") as reader:
        fcntl.flock(reader, fcntl.LOCK_SH)
        with ownership.claim_parts([part]):
            assert reader.closed
