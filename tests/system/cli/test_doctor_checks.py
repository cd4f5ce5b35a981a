"""Checks of `fishctl doctor` that look at a Raspberry Pi's own files, on a tree of such files."""

import errno
import os
import shutil
import sys
from pathlib import Path

import pytest
from rigs.doctor_process import doctor, free_telemetry
from rigs.doctor_tree import Examine, put, unprivileged
from rigs.processes import call

from fishd.cli.doctor import timing
from fishd.cli.doctor.base import Context
from fishd.cli.doctor.bench.measurement import describe_board
from fishd.config import load
from fishd.virtual.pi.gpiochip import EmulatedGpiod, Pins

MODEL, BUS = "proc/device-tree/model", "of_node/clock-frequency"
PI_4 = {MODEL: "Raspberry Pi 4 Model B Rev 1.5\0"}
PI_5 = {MODEL: "Raspberry Pi 5 Model B Rev 1.0\0"}
CHIP = "proc/device-tree/compatible"
ZERO_W = {MODEL: "Raspberry Pi Zero W Rev 1.1\0", CHIP: "raspberrypi,model-zero-w\0brcm,bcm2835\0"}
ZERO_2 = {MODEL: "Raspberry Pi Zero 2 W Rev 1\0", CHIP: "raspberrypi,zero-2-w\0brcm,bcm2837\0"}
DEBIAN = {
    "proc/sys/kernel/osrelease": "6.12.43+deb13-arm64\n",
    "etc/os-release": 'PRETTY_NAME="Debian GNU/Linux 13 (trixie)"\nVERSION_ID="13"\n',
}
RASPBERRY_PI_OS = {
    **DEBIAN,
    "proc/sys/kernel/osrelease": "6.12.47+rpt-rpi-v8\n",
    "etc/rpi-issue": "Raspberry Pi reference 2025-10-01\n",
    "proc/device-tree/__overrides__/any": "",
}
RP1 = {"sys/bus/platform/devices/1f00074000.i2c/uevent": ""}
OWN_KERNEL = (
    "Debian GNU/Linux 13 (trixie) with its own kernel, 6.12.43+deb13-arm64: dtparam= and "
    "dtoverlay= in config.txt do nothing"
)
FAST, SLOW = (speed.to_bytes(4, "big") for speed in (400_000, 100_000))
SPEED, SPEED_BEFORE = f"sys/bus/i2c/devices/i2c-1/{BUS}", f"sys/class/i2c-adapter/i2c-1/{BUS}"
FLAGS = "sys/devices/platform/soc/soc:firmware/get_throttled"
FLAGS_PI_5 = "sys/devices/platform/soc@107c000000/soc@107c000000:firmware/get_throttled"
HWMON = "sys/class/hwmon/hwmon"
MONITOR = {f"{HWMON}0/name": "cpu_thermal\n", f"{HWMON}1/name": "rpi_volt\n"}
ALARM = "sys/class/hwmon/hwmon1/in0_lcrit_alarm"
CPU = "sys/devices/system/cpu/cpu{}/cpufreq/scaling_governor"
GOVERNORS = {CPU.format(number): "performance\n" for number in range(4)}
PINS = {
    "sys/kernel/debug/gpio": "gpiochip0: GPIOs 512-565, parent: platform/fe200000.gpio:\n"
    " gpio-529 (GPIO17              )\n"
    " gpio-530 (GPIO18              |pps-gpio            ) in  lo\n"
    " gpio-539 (GPIO27              |sysfs               ) out lo\n"
}
SYSTEMD = {"run/systemd/system/any": ""}
UNIT = {"etc/systemd/system/fishd.service": "[Service]\n"}
WANTED = {"etc/systemd/system/multi-user.target.wants/fishd.service": ""}
MATRIX = "xx: 2.0, xy: 0.0, x0: 0.0, yx: 0.0, yy: 2.0, y0: 0.0, date: '2026-01-02'"
FORCE = {"state/pi/force-2026-01-02T000000.000000Z.yaml": f"{{{MATRIX}}}\n"}
TARED = {
    "state/pi/force-2026-01-02T000000.000000Z.yaml": "{xx: 1.0, xy: 0.0, x0: 0.3, yx: 0.0, "
    "yy: 1.0, y0: 0.0, date: '2026-01-02', tare_date: '2026-01-02'}\n"
}
SERVO = {
    "state/pi/servo-2026-01-03T000000.000000Z.yaml": "{trim: 10.0, direction: 1, scale: 600.0, "
    "lowest: -1.0, highest: 1.0, date: '2026-01-03'}\n"
}
BACKUP = {"state/pi/force-backup.yaml": f"{{{MATRIX}}}\n"}
BROKEN = {"state/pi/force-2026-02-02T000000.000000Z.yaml": "xx: a lot\n"}

CASES: list[tuple[str, str, str, dict[str, str | bytes], list[str]]] = [
    ("model", "warning", "not a Raspberry Pi", {}, []),
    ("model", "ok", "Raspberry Pi 4 Model B Rev 1.5", PI_4 | {CHIP: "brcm,bcm2711\0"}, []),
    ("model", "FAIL", "too slow", ZERO_W, []),
    ("model", "ok", "Zero 2 W", ZERO_2, []),
    ("system", "", "", {}, []),
    ("system", "warning", f"{OWN_KERNEL}, the PWM of the header is off", PI_4 | DEBIAN,
     ["servo.driver=sysfs-pwm"]),
    ("system", "warning", f"{OWN_KERNEL}, there is no pigpiod", PI_4 | DEBIAN, []),
    ("system", "ok", "Raspberry Pi OS (Debian GNU/Linux 13 (trixie)), kernel 6.12.47+rpt-rpi-v8",
     PI_4 | RASPBERRY_PI_OS, []),
    ("system", "FAIL", "does not know the header of a Pi 5", PI_5 | DEBIAN, []),
    ("system", "warning", OWN_KERNEL, PI_5 | DEBIAN | RP1, []),
    ("i2c bus", "FAIL", "does not exist", {}, []),
    ("i2c bus", "ok", "", {"dev/i2c-1": ""}, []),
    ("i2c bus", "FAIL", "there is i2c-1", {"dev/i2c-1": ""}, ["force_sensor.bus=3"]),
    ("i2c speed", "skipped", "does not state", {}, []),
    ("i2c speed", "ok", "400 kbit/s", {SPEED: FAST}, []),
    ("i2c speed", "warning", "100 kbit/s", {SPEED: SLOW}, []),
    ("i2c speed", "ok", "400 kbit/s", {SPEED_BEFORE: FAST}, []),
    ("i2c speed", "warning", "100 kbit/s", {SPEED_BEFORE: SLOW}, []),
    ("i2c speed", "ok", "less while this Pi's core clock is lowered", {SPEED: FAST} | PI_4, []),
    ("power", "ok", "no under-voltage", {FLAGS: "0\n"}, []),
    ("power", "FAIL", "under-voltage", {FLAGS: "1\n"}, []),
    ("power", "FAIL", "under-voltage", {FLAGS: "50005\n"}, []),
    ("power", "warning", "the Pi is throttled", {FLAGS: "4\n"}, []),
    ("power", "warning", "too hot", {FLAGS: "8\n"}, []),
    ("power", "warning", "has been under-voltage and throttled", {FLAGS: "50000\n"}, []),
    ("power", "ok", "no under-voltage", {FLAGS_PI_5: "0\n"}, []),
    ("power", "FAIL", "under-voltage", {FLAGS_PI_5: "50005\n"}, []),
    ("power", "skipped", "does not report", {}, []),
    ("power", "ok", "no under-voltage", MONITOR | {ALARM: "0\n"}, []),
    ("power", "FAIL", "under-voltage", MONITOR | {ALARM: "1\n"}, []),
    ("governor", "skipped", "", {}, []),
    ("governor", "ok", "performance", GOVERNORS, []),
    ("governor", "warning", "slows down", GOVERNORS | {min(GOVERNORS): "ondemand\n"}, []),
    ("clock", "ok", "", {"run/systemd/timesync/synchronized": ""}, []),
    ("pigpiod", "FAIL", "set servo.driver: sysfs-pwm", PI_5, []),
    ("pigpiod", "", "", PI_5, ["servo.driver=sysfs-pwm"]),
    ("pigpiod", "FAIL", "systemctl enable --now pigpiod", {"usr/bin/pigpiod": ""},
     ["servo.port=1"]),
    ("pigpiod", "FAIL", "apt install pigpio", RASPBERRY_PI_OS, ["servo.port=1"]),
    ("pigpiod", "FAIL", "Debian has no pigpiod", DEBIAN, ["servo.port=1"]),
    ("gpio pins", "warning", "GPIO18 (servo.gpio) is used by pps-gpio", PINS, []),
    ("gpio pins", "ok", "", PINS, ["servo.gpio=17"]),
    ("gpio pins", "warning", "GPIO27", PINS, ["servo.gpio=17", "panel.led_gpio=27"]),
    ("gpio package", "", "", {}, []),
    ("gpio package", "ok", "rpi-lgpio", PI_5, ["servo.driver=rpi-gpio"]),
    ("gpio chip", "", "", {}, []),
    ("amplifier", "ok", "", {}, ["force_sensor.full_scale=2.048"]),
    ("amplifier", "ok", "", {}, ["force_sensor.full_scale=4.096"]),
    ("amplifier", "warning", "would count as a force", {},
     ["force_sensor.full_scale=4.096", "force_sensor.saturation_high=null"]),
    ("amplifier", "warning", "would count as a force", {},
     ["force_sensor.channel_x=A0", "force_sensor.channel_y=A1"]),
    ("amplifier", "ok", "", {}, ["force_sensor.channel_x=A0", "force_sensor.channel_y=A1",
     "force_sensor.saturation_low=0.1"]),
    ("systemd", "skipped", "", {}, []),
    ("systemd", "warning", "install the Debian package", SYSTEMD, []),
    ("systemd", "warning", "enable --now", SYSTEMD | UNIT, []),
    ("systemd", "ok", "", SYSTEMD | UNIT | WANTED, []),
    ("state folder", "ok", "", {}, []),
    ("state folder", "FAIL", "is not a folder", {"state": "a file"}, []),
    ("calibrations", "warning", "fishctl calibrate force", {}, []),
    ("calibrations", "warning", "fishctl calibrate servo", FORCE, []),
    ("calibrations", "ok", "2026-01-02 (its uncertainty is unknown), servo of 2026-01-03",
     FORCE | SERVO, []),
    ("calibrations", "warning", "force-backup.yaml is not a dated calibration file and is ignored",
     FORCE | SERVO | BACKUP, []),
    ("calibrations", "FAIL", "force-2026-02-02", FORCE | SERVO | BROKEN, []),
    ("calibrations", "warning", "tared 2026-01-02, but never calibrated", TARED, []),
]  # fmt: skip


@pytest.mark.parametrize(
    ("check", "level", "words", "files", "settings"),
    CASES,
    ids=[f"{check}: {level} {words[:30]}" for check, level, words, *_ in CASES],
)
def test_a_check_reports_the_state_of_a_pi(
    root: Path,
    examine: Examine,
    check: str,
    level: str,
    words: str,
    files: dict[str, str | bytes],
    settings: list[str],
) -> None:
    for path, content in files.items():
        put(root, path, content)
    actual_level, message, mend = examine(check, *settings)
    assert (actual_level, words in f"{message}; {mend}") == (level, True), message


@pytest.mark.parametrize("flags", [FLAGS, FLAGS_PI_5])
def test_a_report_of_the_bench_has_the_power_and_heat_of_each_board(root: Path, flags: str) -> None:
    zone = "sys/class/thermal/thermal_zone"
    files = {
        flags: "50005\n",
        f"{zone}0/type": "nvme\n",
        f"{zone}0/temp": "31000\n",
        f"{zone}1/type": "cpu-thermal\n",
        f"{zone}1/temp": "48312\n",
    }
    for path, content in files.items():
        put(root, path, content)
    config = load(None, ["robot=pi", f"state_folder={root}/state"])
    board = describe_board(Context(config, None, f"ipc://{root}/nobody", root))
    assert (board.throttled, board.temperature) == ("50005", 48.312)


def skip_unless_root() -> None:
    if os.geteuid() != 0:
        pytest.skip("needs root: a file gets another owner or group")


@pytest.mark.parametrize(
    ("group", "mode", "remedy"),
    [
        ("daemon", 0o660, "usermod -aG daemon"),
        ("daemon", 0o600, "install the Debian package"),  # to join the group would not help
        ("root", 0o660, "install the Debian package"),
    ],
)
def test_the_i2c_bus_must_be_accessible_to_this_user(
    root: Path, examine: Examine, group: str, mode: int, remedy: str
) -> None:
    skip_unless_root()
    device = put(root, "dev/i2c-1")
    shutil.chown(device, group=group)
    device.chmod(mode)
    with unprivileged():
        level, _, mend = examine("i2c bus")
    assert (level, remedy in mend) == ("FAIL", True)


@pytest.mark.parametrize(
    ("owner", "remedy"),
    [(0, "sudo -u fishd fishctl doctor"), (1, "sudo -u daemon fishctl doctor"), (65534, "chmod")],
)
def test_a_state_folder_of_another_user_keeps_its_owner(
    root: Path, examine: Examine, owner: int, remedy: str
) -> None:
    skip_unless_root()
    folder = root / "state" / "pi"
    folder.mkdir(parents=True)
    os.chown(folder, owner, owner)
    folder.chmod(0o500)
    with unprivileged():
        level, _, mend = examine("state folder")
    assert (level, remedy in mend) == ("FAIL", True)
    assert "chown" not in mend
    assert "set state_folder" in mend


@pytest.mark.slow
def test_a_read_only_file_system_is_not_taken_for_a_permission(root: Path) -> None:
    (root / "state").mkdir()
    mount = 'mount -t tmpfs -o ro none "$0" && exec "$@"'
    command = ["unshare", *([] if os.geteuid() == 0 else ["-r"]), "-m", "sh", "-c", mount]
    if call(*command, str(root / "state"), "true").returncode:
        pytest.skip("needs permission to mount a file system")
    settings = ("--set", "robot=pi", "--set", f"state_folder={root}/state", *free_telemetry())
    _, findings = doctor(root, *settings, under=(*command, str(root / "state")))
    level, message = findings["state folder"]
    assert level == "FAIL"
    assert f"{root}/state is on a read-only file system" in message


def test_the_reason_for_unknown_users_of_pins_is_reported(root: Path, examine: Examine) -> None:
    only_root = "only root can see who uses GPIO pins: sudo fishctl doctor"
    if os.geteuid() == 0:
        (root / "sys/kernel/debug").mkdir(parents=True)
        assert "debugfs is not mounted: mount -t debugfs none /" in examine("gpio pins")[1]
        put(root, "sys/kernel/debug/clk/clk_summary")
        assert "this kernel does not say who uses GPIO pins" in examine("gpio pins")[1]
    with unprivileged():
        assert examine("gpio pins") == ("skipped", only_root, "")


def test_the_pwm_channel_must_be_there_and_silent(root: Path, examine: Examine) -> None:
    driver = "servo.driver=sysfs-pwm"
    assert examine("pwm") == ("", "", "")
    assert examine("pwm", driver)[0] == "FAIL"
    chip, device = root / "sys/class/pwm/pwmchip2", root / "devices/1f00098000.pwm"
    for folder in (chip, device):
        folder.mkdir(parents=True)
    (chip / "device").symlink_to(device)
    for name in ("period", "duty_cycle", "enable"):
        put(chip, f"pwm2/{name}", "0\n")
    assert examine("pwm", driver)[0] == "ok"
    put(chip, "pwm2/enable", "1\n")
    duty = put(chip, "pwm2/duty_cycle", "1500000\n")
    level, _, mend = examine("pwm", driver)
    assert (level, mend) == ("warning", "fishctl release")
    assert duty.read_text() == "1500000\n"


def test_pins_that_no_package_reaches_fail(
    examine: Examine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An installation without the package works, but doctor must report it."""
    monkeypatch.setattr("fishd.hardware.header._PROVIDERS", ())
    level, message, mend = examine("gpio package", "servo.driver=rpi-gpio")
    assert level == "FAIL"
    assert message == "neither RPi.GPIO nor rpi-lgpio is installed, but driver rpi-gpio needs one"
    assert "[rpi-lgpio]" in mend
    monkeypatch.setitem(sys.modules, "gpiod", None)
    assert examine("gpio package") == ("", "", "")
    level, message, mend = examine("gpio chip", "panel.estop_gpio=17")
    assert (level, "need the package gpiod, 2.3 or later" in message) == ("FAIL", True)
    assert mend.endswith("[pi]'")


def test_the_older_library_is_refused_on_a_pi_5(
    root: Path, examine: Examine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fishd.hardware.header._PROVIDERS", ("RPi.GPIO",))
    info = tmp_path / "RPi_GPIO-0.7.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: RPi.GPIO\nVersion: 0.7.1\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert examine("gpio package", "servo.driver=rpi-gpio")[:2] == ("ok", "RPi.GPIO")
    for path, content in PI_5.items():
        put(root, path, content)
    level, message, mend = examine("gpio package", "servo.driver=rpi-gpio")
    assert (level, message) == ("FAIL", "RPi.GPIO does not work on a Pi 5")
    assert mend.endswith("[rpi-lgpio]'")


def test_the_chip_of_the_pins_must_be_accessible_to_this_user(examine: Examine) -> None:
    chip = Pins()
    with EmulatedGpiod(None, chip):
        assert examine("gpio chip", "panel.estop_gpio=17") == ("ok", "/dev/gpiochip1", "")
        chip.error = errno.EACCES
        assert examine("gpio chip", "panel.estop_gpio=17") == (
            "FAIL",
            "/dev/gpiochip1 may not be opened by this user",
            "'sudo usermod -aG gpio USER', log in again, then try again",
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("priority", "words"),
    [
        (50, "as its systemd service, or allow 'rtprio 51' in"),
        (60, "service with LimitRTPRIO=61 (sudo systemctl edit fishd), or allow 'rtprio 61' in"),
        (99, "or allow 'rtprio 99' in"),
    ],
)
def test_without_real_time_permission_the_sufficient_limit_is_named(
    examine: Examine, monkeypatch: pytest.MonkeyPatch, priority: int, words: str
) -> None:
    monkeypatch.setattr(timing, "_TRIAL", "raise SystemExit(1)")
    level, _, mend = examine("real time", f"realtime.priority={priority}")
    assert (level, words in mend) == ("warning", True), mend


@pytest.mark.slow
def test_a_limit_that_leaves_nothing_above_the_loop_is_a_warning(
    examine: Examine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timing, "_TRIAL", "import sys; sys.exit(int(sys.argv[1]) > 50)")
    level, message, mend = examine("real time", "realtime.priority=50")
    assert level == "warning"
    assert message.startswith("SCHED_FIFO 50 is permitted, but not 51, which the thread needs")
    assert "allow 'rtprio 51' in" in mend
    assert examine("real time", "realtime.priority=49")[0] == "ok"
