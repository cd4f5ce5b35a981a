"""`fishd-release`: as `fishctl release`, by the recipe that fishd leaves, and in little time."""

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pigpio
import pytest
from rigs.operator_rig import Bench, bench
from rigs.pigpiod_client import dispose
from rigs.processes import PATIENCE, Process, call, fishctl, wait_until

from fishd.client import Fish
from fishd.core.calibration import ServoCalibration
from fishd.hardware import release_recipe
from fishd.hardware.servo.sysfs_pwm import SysfsPwm, SysfsPwmSettings

HEAVY = ("click", "msgspec", "numpy", "pathlib", "yaml", "zmq")
SOURCE = f"""
import sys
from fishd.cli.fishd_release import main
try:
    main()
finally:
    print("loaded:", *[name for name in {HEAVY} if name in sys.modules], file=sys.stderr)
"""
MAX_CPU_S = 0.15
"""Largest CPU time of a release, with the start of Python [s]."""


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Runtime folder of the service, for fishd and the command that systemd runs after it."""
    folder = tmp_path / "runtime"
    folder.mkdir()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(folder))
    return folder


@pytest.fixture
def file(pi: Bench) -> Path:
    """Configuration file for the virtual Pi."""
    return file_for(pi)


Remains = tuple[Bench, Path, Path]
"""Virtual Pi, configuration file of the fishd that was killed on it, and its recipe."""


@pytest.fixture(scope="module")
def remains_of_module(process: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Remains]:
    folder = tmp_path_factory.mktemp("killed")
    with bench(process, folder) as pi:
        file = file_for(pi)
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv("RUNTIME_DIRECTORY", str(folder))
            run_and_kill_fishd(pi, file)
            recipe = Path(release_recipe._path(str(file)))
        yield pi, file, recipe


@pytest.fixture
def remains(remains_of_module: Remains, runtime: Path) -> Iterator[Remains]:
    """State that a killed fishd has left: virtual Pi, configuration file and recipe."""
    pi, file, recipe = remains_of_module
    yield pi, file, Path(shutil.copy2(recipe, runtime))
    pi.pi.clear()


@pytest.fixture
def killed(remains: Remains) -> Iterator[Remains]:
    """The same state, while another program keeps the pulses on."""
    with foreign_pulses(remains[0]):
        yield remains


@contextmanager
def changed_file(file: Path) -> Iterator[None]:
    """Change the file; restore it afterwards, with its times, which `release_recipe` compares."""
    text, status = file.read_text(), file.stat()
    file.write_text(f"{text}# changed\n")
    try:
        yield
    finally:
        file.write_text(text)
        os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))


def file_for(pi: Bench) -> Path:
    path = pi.folder / "fishd.yaml"
    path.write_text(fishctl("config", "show", *pi.settings).stdout)
    return path


@contextmanager
def foreign_pulses(pi: Bench) -> Iterator[None]:
    client = pigpio.pi("127.0.0.1", pi.pi.port(), show_errors=False)
    try:
        for script in range(32):  # the countdown would also end these pulses
            with suppress(pigpio.error):
                client.delete_script(script)
        client.set_servo_pulsewidth(18, 1750)
        pi.wait_for_pulse(1750, 1750)
        yield
    finally:
        dispose(client)


def run_and_kill_fishd(pi: Bench, file: Path, calibration: ServoCalibration | None = None) -> None:
    with pi.daemon("--config", str(file)) as daemon:
        if calibration:
            with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
                fish.calibrate_servo(calibration, save=True)
        daemon.kill()


def release(*words: str, **env: str) -> subprocess.CompletedProcess[str]:
    return call(sys.executable, "-c", SOURCE, *words, env=os.environ | env)


def error_lines(ended: subprocess.CompletedProcess[str]) -> list[str]:
    """Return the lines on standard error, without that of the modules."""
    return [line for line in ended.stderr.splitlines() if not line.startswith("loaded:")]


def test_it_ends_pulses_at_neutral_and_costs_little_time(killed: Remains) -> None:
    pi, file, _ = killed
    ended = release("--config", str(file), SERVICE_RESULT="signal")
    assert ended.returncode == 0
    assert ended.stderr == "loaded:\n"
    assert ended.stdout == ("the service ended with 'signal': pulses were on: neutral, then off\n")
    assert pi.pi.widths()[-3:] == [1750, 1500, 0]
    assert release("--config", str(file)).stdout == "there were no pulses\n"
    assert min(cpu_of_a_release(file) for _ in range(5)) < MAX_CPU_S


def cpu_of_a_release(file: Path) -> float:
    """Return the CPU time of a release, with the start of Python [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    call(sys.executable, "-m", "fishd.cli.fishd_release", "--config", str(file), check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_neutral_is_that_of_a_calibration_made_while_it_ran(pi: Bench, file: Path) -> None:
    run_and_kill_fishd(pi, file, ServoCalibration(trim=-40.0))
    with foreign_pulses(pi):
        ended = release("--config", str(file))
    assert (ended.returncode, ended.stderr) == (0, "loaded:\n")
    assert pi.pi.widths()[-2:] == [1460, 0]


def test_without_a_sound_recipe_it_does_what_fishctl_does(remains: Remains) -> None:
    pi, file, path = remains
    sound = path.read_text()

    def check() -> None:
        with foreign_pulses(pi):
            ended = release("--config", str(file))
        assert (ended.returncode, error_lines(ended)) == (0, [])
        assert ended.stdout == "pulses were on: neutral, then off\n"
        assert "click" in ended.stderr

    assert release_recipe.read(str(file))
    for damaged in ("", "{}", "[1]", '{"config": 3}', "\0", "nul" * 30_000):
        path.write_text(damaged)
        assert release_recipe.read(str(file)) is None
    check()
    path.write_text(sound)
    path.chmod(0o666)  # others may have written it
    assert release_recipe.read(str(file)) is None
    path.unlink()
    check()


def test_a_file_that_has_changed_since_counts_too(killed: Remains) -> None:
    _, file, _ = killed
    with changed_file(file):
        ended = release("--config", str(file))
    assert (ended.returncode, error_lines(ended)) == (0, [])
    assert ended.stdout == "pulses were on: neutral, then off\nthere were no pulses\n"


def test_a_simulated_fish_leaves_the_recipe_of_a_robot_alone_unless_the_file_has_changed(
    remains: Remains, runtime: Path
) -> None:
    pi, file, recipe = remains
    simulated = ("--config", str(file), "--set", "robot=simulated")
    with pi.daemon(*simulated):
        assert recipe.exists()
    with changed_file(file), pi.daemon(*simulated):
        assert not recipe.exists()


def test_a_pigpiod_that_is_gone_is_the_line_and_the_status_of_fishctl(killed: Remains) -> None:
    pi, file, _ = killed
    pi.pi.inject("pigpiod-gone")
    ended = release("--config", str(file))
    assert (ended.returncode, ended.stdout) == (1, "")
    (line,) = error_lines(ended)
    assert re.fullmatch(r"fishctl: pigpiod at 127.0.0.1:\d+: Connection refused; the .*", line)


@pytest.mark.parametrize("words", [(), ("--config", "/nowhere/fishd.yaml"), ("--steam",)])
def test_fishctl_handles_all_other_arguments(words: tuple[str, ...]) -> None:
    quick, slow = release(*words), fishctl("release", *words)
    assert slow.returncode != 0
    assert (quick.returncode, quick.stdout) == (slow.returncode, slow.stdout)
    assert error_lines(quick) == slow.stderr.splitlines()


def powered_channel(folder: Path, *, enabled: int = 1, recipe: bool = True) -> tuple[Path, Path]:
    """Return a PWM channel of the kernel with pulses, and the configuration file of its servo.

    recipe: whether a fishd has left a recipe for `fishd-release`
    """
    channel = folder / "pwm" / "pwmchip3" / "pwm2"
    channel.mkdir(parents=True)
    device = folder / "devices" / "1f00098000.pwm"
    device.mkdir(parents=True)
    (channel.parent / "device").symlink_to(device)
    for name, value in (("period", 20_000_000), ("duty_cycle", 1_800_000), ("enable", enabled)):
        (channel / name).write_text(f"{value}\n")
    file = folder / "fishd.yaml"
    servo = f"{{driver: sysfs-pwm, root: {folder / 'pwm'}}}"
    file.write_text(f"robot: pi\nservo: {servo}\nstate_folder: {folder}\n")
    if recipe:
        function, arguments = SysfsPwm.last_resort(SysfsPwmSettings(root=str(folder / "pwm")))
        release_recipe.write(str(file), function, 1490.0, arguments)
    return channel, file


def duty_and_enable(channel: Path) -> tuple[int, int]:
    """Return the duty cycle and enable flag of a channel; -1 for a file that is being written."""
    duty, on = ((channel / name).read_text().split() for name in ("duty_cycle", "enable"))
    return int(duty[0]) if duty else -1, int(on[0]) if on else -1


@pytest.mark.parametrize("recipe", [True, False])
@pytest.mark.parametrize("enabled", [1, 0])
def test_the_kernels_pwm_is_released_too(tmp_path: Path, enabled: int, recipe: bool) -> None:
    channel, file = powered_channel(tmp_path, enabled=enabled, recipe=recipe)
    ended = release("--config", str(file))
    assert (ended.returncode, error_lines(ended)) == (0, [])
    assert ("click" in ended.stderr) != recipe
    assert ended.stdout.startswith("pulses were on" if enabled else "there were no pulses")
    assert duty_and_enable(channel) == ((0, 0) if enabled else (1_800_000, 0))


@pytest.mark.parametrize("program", ["fishd-release", "fishctl release"])
@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
def test_a_lost_session_or_ctrl_c_at_neutral_does_not_leave_the_servo_powered(
    tmp_path: Path, number: int, program: str
) -> None:
    channel, file = powered_channel(tmp_path)
    words = program.split()
    words[0] = str(Path(sys.executable).with_name(words[0]))
    process = Process(*words, "--config", str(file))
    wait_until(lambda: duty_and_enable(channel)[0] not in (-1, 1_800_000) or has_ended(process))
    code, out, errors = process.end(number)
    assert (code, out, errors) == (0, "pulses were on: neutral, then off\n", "")
    assert duty_and_enable(channel) == (0, 0)


def has_ended(process: Process) -> bool:
    return process.process.poll() is not None
