"""The files of systemd/, verified by systemd: units, users, folders, udev rules."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from rigs.documents import ROOT
from rigs.processes import call

from fishd.cli.doctor import timing
from fishd.config import Config, load

SYSTEMD = ROOT / "systemd"
ON_THE_ROBOT = ("fishd.service", "fishd-failure.service")
UNITS = (*ON_THE_ROBOT, "fishd-recorder.service", "fishd-camera.service", "fishd-window.service")
MAX_EXPOSURE = 2.0
"""Largest exposure level of `systemd-analyze security`: 0 is closed, 10 is open."""
SHIPPED_UNITS = Path("/usr/lib/systemd/system")

PIGPIOD = """\
[Unit]
Description=As Debian ships it
[Service]
ExecStart=/usr/bin/pigpiod -l
ExecStop=/bin/systemctl kill pigpiod
Type=forking
[Install]
WantedBy=multi-user.target
"""


def need(tool: str, package: str) -> None:
    if shutil.which(tool) is None:
        pytest.skip(f"{tool} is not installed: apt install {package}")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Return a root folder with the units of fishd and systemd, and the programs they start."""
    need("systemd-analyze", "systemd")
    own = tmp_path / "etc/systemd/system"
    shutil.copytree(SYSTEMD, own)
    shutil.copytree(SHIPPED_UNITS, tmp_path / "usr/lib/systemd/system", symlinks=True)
    (tmp_path / "usr/lib/systemd/system/pigpiod.service").write_text(PIGPIOD)
    fishd = "usr/lib/fishd/bin/fishd"
    fishctl = "usr/lib/fishd/bin/fishctl"
    own_programs = (fishd, f"{fishd}-release", fishctl, f"{fishd}-camera", f"{fishd}-window")
    for program in (*own_programs, "usr/bin/pigpiod", "bin/sh", "bin/systemctl"):
        (tmp_path / program).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / program).touch(0o755)
    return tmp_path


def verify(root: Path, *units: str) -> str:
    """Return the output of `systemd-analyze verify`, whose exit status is 0 for many mistakes."""
    return call("systemd-analyze", "verify", "--man=no", f"--root={root}", *units).stderr


def setting(unit: str, key: str) -> list[str]:
    """Return the values of a key, in order."""
    return re.findall(rf"^{key}=(.*)$", (SYSTEMD / unit).read_text(), flags=re.MULTILINE)


@pytest.mark.parametrize("unit", [*UNITS, "pigpiod.service"])
def test_systemd_has_nothing_to_say_against_a_unit(root: Path, unit: str) -> None:
    assert verify(root, unit) == ""


def test_a_misspelt_key_would_be_found(root: Path) -> None:
    unit = root / "etc/systemd/system/fishd.service"
    unit.write_text(unit.read_text().replace("WatchdogSec=", "WatchdogSeconds="))
    assert "WatchdogSeconds" in verify(root, "fishd.service")


def test_a_pi_without_pigpiod_is_no_error(root: Path) -> None:
    (root / "usr/lib/systemd/system/pigpiod.service").unlink()
    assert verify(root, "fishd.service") == ""


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_is_hardly_exposed(unit: str) -> None:
    need("systemd-analyze", "systemd")
    threshold = f"--threshold={MAX_EXPOSURE * 10:.0f}"
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", threshold]
    done = call(*command, SYSTEMD / unit)
    score = re.search(r"Overall exposure level for \S+: ([0-9.]+)", done.stdout)
    assert score, done.stderr
    assert float(score[1]) <= MAX_EXPOSURE
    assert done.returncode == 0


def test_what_the_hardware_needs_stays_open() -> None:
    need("systemd-analyze", "systemd")
    command = ["systemd-analyze", "security", "--offline=true", "--json=short"]
    rows = json.loads(call(*command, SYSTEMD / "fishd.service").stdout)
    open_ = {row["json_field"] for row in rows if row["set"] is False}
    assert {
        "PrivateDevices",  # would hide I2C
        "ProtectKernelTunables",  # would make the kernel's PWM read-only
        "ProcSubset",  # would hide /proc/cpuinfo from board detection
        "RestrictRealtime",  # would forbid SCHED_FIFO
        "SystemCallFilter_resources",
        "MemoryDenyWriteExecute",  # would break controllers that are compiled as they run
        "RestrictAddressFamilies_AF_UNIX",
        "RestrictAddressFamilies_AF_INET_INET6",
    } <= open_


ROBOT_DEVICES = ["char-i2c rw", "char-gpiochip rw", "char-*gpiomem* rw"]
SETTINGS: list[tuple[str, dict[str, list[str]]]] = [
    ("fishd.service", {"Restart": ["on-failure"], "RestartPreventExitStatus": ["78"]}),
    # The other processes carry telemetry and requests, which fishd needs while it fades.
    ("fishd.service", {"KillMode": ["mixed"], "LimitNOFILE": ["4096"]}),
    ("fishd.service", {"DevicePolicy": ["closed"], "DeviceAllow": ROBOT_DEVICES}),
    ("fishd-failure.service", {"DevicePolicy": ["closed"], "DeviceAllow": ROBOT_DEVICES}),
    ("fishd.service", {"SupplementaryGroups": ["i2c gpio"], "User": ["fishd"]}),
    ("fishd-failure.service", {"SupplementaryGroups": ["i2c gpio"]}),
    ("fishd-recorder.service", {"PrivateDevices": ["yes"], "IOSchedulingClass": ["idle"]}),
    ("fishd-recorder.service", {"Environment": ["FISHD_ENDPOINT=ipc:///run/fishd/control"]}),
    ("fishd-recorder.service", {"User": ["fishd"]}),
    ("fishd-camera.service", {"DevicePolicy": ["closed"], "DeviceAllow": ["char-video4linux rw"]}),
    ("fishd-camera.service", {"SupplementaryGroups": ["video"], "User": ["fishd"]}),
    ("fishd-camera.service", {"RestartPreventExitStatus": ["78"]}),
]
BOUNDS = [
    ("fishd.service", "MemoryMax", 1, 300),
    ("fishd.service", "TasksMax", 1, 64),
    ("fishd-recorder.service", "Nice", 1, 19),
    ("fishd-camera.service", "Nice", 1, 19),
    # This also limits ExecStopPost=, which takes 3 s on an idle Zero 2 W.
    ("fishd.service", "TimeoutStopSec", 20, 90),
    ("fishd-failure.service", "TimeoutStartSec", 20, 90),
]
"""Unit, key, and the smallest and largest number it may have."""


@pytest.mark.parametrize(("unit", "values"), SETTINGS, ids=str)
def test_a_unit_gives_way_to_fishd_and_reaches_its_own_devices_only(
    unit: str, values: dict[str, list[str]]
) -> None:
    assert {key: setting(unit, key) for key in values} == values


@pytest.mark.parametrize(("unit", "key", "low", "high"), BOUNDS)
def test_a_unit_takes_no_more_than_a_pi_has_and_gets_the_time_that_it_needs(
    unit: str, key: str, low: int, high: int
) -> None:
    (value,) = setting(unit, key)
    assert low <= int(value.removesuffix("M")) <= high


def test_the_servo_is_released_however_the_daemon_ends() -> None:
    (release,) = setting("fishd.service", "ExecStopPost")
    (start,) = setting("fishd.service", "ExecStart")
    assert release.startswith("/usr/lib/fishd/bin/fishd-release --config ")
    assert release.rpartition(" ")[2] == start.rpartition(" ")[2]
    (last_resort,) = (
        line for line in setting("fishd-failure.service", "ExecStart") if "fishd-release" in line
    )
    assert last_resort == f"-{release}"


def test_the_daemon_and_the_unit_agree_on_real_time() -> None:
    priority = int(setting("fishd.service", "LimitRTPRIO")[0])
    assert priority == timing.SERVICE_PRIORITY_LIMIT
    # The watchdog thread, one above, ends a fishd that hangs
    assert priority > Config().realtime.priority
    assert int(setting("pigpiod.service.d/fishd.conf", "CPUSchedulingPriority")[0]) > priority


def test_the_config_for_the_pi_is_valid_and_at_rest() -> None:
    config = load(SYSTEMD.parent / "config/pi.yaml")
    assert config.robot == "pi"
    assert config.start.controller is None
    (state,) = setting("fishd.service", "StateDirectory")
    assert config.state_folder == f"/var/lib/{state}"


def test_the_user_of_the_service_is_made_with_the_groups_of_the_devices(tmp_path: Path) -> None:
    need("systemd-sysusers", "systemd")
    folder = tmp_path / "etc/sysusers.d"
    folder.mkdir(parents=True)
    shutil.copy(SYSTEMD / "sysusers.d/fishd.conf", folder)
    done = call("systemd-sysusers", "--dry-run", f"--root={tmp_path}", "fishd.conf")
    assert done.returncode == 0, done.stderr
    for made in ("group 'i2c'", "group 'gpio'", "group 'fishd'", "user 'fishd'"):
        assert f"Creating {made}" in done.stdout + done.stderr
    assert setting("fishd.service", "User") == ["fishd"]


def test_the_folders_are_made_as_the_service_wants_them(tmp_path: Path) -> None:
    need("systemd-tmpfiles", "systemd")
    if os.geteuid() != 0:
        pytest.skip("needs root: folders get another owner")
    for kind in ("sysusers.d", "tmpfiles.d"):
        (tmp_path / "etc" / kind).mkdir(parents=True)
        shutil.copy(SYSTEMD / kind / "fishd.conf", tmp_path / "etc" / kind)
    assert call("systemd-sysusers", f"--root={tmp_path}", "fishd.conf").returncode == 0
    done = call("systemd-tmpfiles", "--create", f"--root={tmp_path}", "fishd.conf")
    assert (done.returncode, done.stderr) == (0, "")
    state = (tmp_path / "var/lib/fishd").stat()
    assert f"{state.st_mode & 0o7777:04o}" == setting("fishd.service", "StateDirectoryMode")[0]
    assert state.st_uid != 0
    assert (tmp_path / "etc/fishd").stat().st_uid == 0


def test_udev_has_nothing_to_say_against_the_rules() -> None:
    need("udevadm", "udev")
    if call("udevadm", "verify", "--help").returncode != 0:
        pytest.skip("this udevadm cannot verify: systemd 254 or later is needed")
    rules = SYSTEMD / "udev/rules.d/60-fishd.rules"
    done = call("udevadm", "verify", "--resolve-names=never", rules)
    assert done.returncode == 0, done.stdout + done.stderr


def test_each_subsystem_of_the_robot_has_a_rule() -> None:
    text = (SYSTEMD / "udev/rules.d/60-fishd.rules").read_text()
    rules = [line for line in text.splitlines() if line and not line.startswith("#")]
    subsystems = [re.match(r'SUBSYSTEM=="([^"]+)"', rule)[1] for rule in rules]  # type: ignore[index]
    assert subsystems == ["i2c-dev", "gpio", "*gpiomem", "pwm"]


def test_the_pwm_rule_hands_a_channel_to_the_group(tmp_path: Path) -> None:
    """Run the rule's command on a folder like that of a chip with an exported channel."""
    text = (SYSTEMD / "udev/rules.d/60-fishd.rules").read_text()
    command = re.search(r"RUN\+=\"/bin/sh -c '([^']+)'\"", text)
    assert command
    chip = tmp_path / "pwmchip0"
    (chip / "pwm2").mkdir(parents=True)
    for name, mode in (("export", 0o200), ("npwm", 0o444), ("pwm2/enable", 0o644)):
        (chip / name).touch(mode)
        (chip / name).chmod(mode)
    own = command[1].replace("/sys%p", str(chip)).replace("gpio", str(os.getgid()))
    subprocess.run(["/bin/sh", "-c", own], check=True)
    modes = {p.name: p.stat().st_mode & 0o777 for p in chip.rglob("*") if p.is_file()}
    assert modes == {"export": 0o220, "npwm": 0o444, "enable": 0o664}


def test_pigpiod_listens_where_fishd_asks() -> None:
    from fishd.hardware.servo.pigpio import PigpioSettings

    words = setting("pigpiod.service.d/fishd.conf", "ExecStart")[-1].split()
    assert words[words.index("-n") + 1] == PigpioSettings().host
    assert "-l" in words
