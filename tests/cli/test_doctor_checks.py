"""Checks of `fishctl doctor` that look at a Raspberry Pi's own files, on a tree of such files."""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from doctor_tree import Examine, level, put
from test_doctor import doctor, free_telemetry


def test_the_i2c_bus_must_be_there(root: Path, examine: Examine) -> None:
    assert level(examine("i2c bus")) == "FAIL"
    put(root, "dev/i2c-1")
    assert level(examine("i2c bus")) == "ok"
    other = examine("i2c bus", "force_sensor.bus=3")
    assert level(other) == "FAIL"
    assert other is not None
    assert "there is i2c-1" in other.message


@pytest.mark.parametrize(
    ("group", "mode", "remedy"),
    [
        ("daemon", 0o660, "usermod -aG daemon"),
        ("daemon", 0o600, "make install-pi"),  # to join the group would not help
        ("root", 0o660, "make install-pi"),
    ],
)
def test_the_i2c_bus_must_be_accessible_to_this_user(
    root: Path, examine: Examine, group: str, mode: int, remedy: str
) -> None:
    if os.geteuid() != 0:
        pytest.skip("needs root: a device gets another group")
    device = put(root, "dev/i2c-1")
    shutil.chown(device, group=group)
    device.chmod(mode)
    with unprivileged():
        found = examine("i2c bus")
    assert level(found) == "FAIL"
    assert found is not None
    assert remedy in found.mend


@pytest.mark.parametrize(
    ("owner", "remedy"),
    [(0, "sudo -u fishd fishctl doctor"), (1, "sudo -u daemon fishctl doctor"), (65534, "chmod")],
)
def test_a_state_folder_of_another_user_is_not_taken_away_from_him(
    root: Path, examine: Examine, owner: int, remedy: str
) -> None:
    if os.geteuid() != 0:
        pytest.skip("needs root: a folder gets another owner")
    folder = root / "state" / "pi"
    folder.mkdir(parents=True)
    os.chown(folder, owner, owner)
    folder.chmod(0o500)
    with unprivileged():
        found = examine("state folder")
    assert level(found) == "FAIL"
    assert found is not None
    assert remedy in found.mend
    assert "chown" not in found.mend
    assert "set state_folder" in found.mend


@contextlib.contextmanager
def unprivileged() -> Iterator[None]:
    """As user 65534; the groups are given back as well."""
    groups = os.getgroups()
    os.setgroups([])
    os.setresgid(65534, 65534, 0)
    os.setresuid(65534, 65534, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)
        os.setresgid(0, 0, 0)
        os.setgroups(groups)


def test_pigpio_on_a_pi_5_fails_before_anything_is_tried(root: Path, examine: Examine) -> None:
    put(root, "proc/device-tree/model", "Raspberry Pi 5 Model B Rev 1.0\0")
    found = examine("pigpiod")
    assert level(found) == "FAIL"
    assert found is not None
    assert "sysfs-pwm" in found.mend
    assert examine("pigpiod", "servo.driver=sysfs-pwm") is None


@pytest.mark.parametrize(
    ("flags", "expected", "word"),
    [
        ("0", "ok", "no under-voltage"),
        ("1", "FAIL", "under-voltage"),
        ("50005", "FAIL", "under-voltage"),
        ("4", "warning", "the Pi is throttled"),
        ("8", "warning", "too hot"),
        ("50000", "warning", "has been under-voltage and throttled"),
    ],
)
def test_the_firmwares_word_on_power_is_understood(
    root: Path, examine: Examine, flags: str, expected: str, word: str
) -> None:
    put(root, "sys/devices/platform/soc/soc:firmware/get_throttled", f"{flags}\n")
    found = examine("power")
    assert level(found) == expected
    assert found is not None
    assert word in found.message


def test_without_the_firmware_the_kernels_alarm_is_asked(root: Path, examine: Examine) -> None:
    assert level(examine("power")) == "skipped"
    put(root, "sys/class/hwmon/hwmon0/name", "cpu_thermal\n")
    put(root, "sys/class/hwmon/hwmon1/name", "rpi_volt\n")
    put(root, "sys/class/hwmon/hwmon1/in0_lcrit_alarm", "0\n")
    assert level(examine("power")) == "ok"
    put(root, "sys/class/hwmon/hwmon1/in0_lcrit_alarm", "1\n")
    assert level(examine("power")) == "FAIL"


def test_a_governor_that_slows_any_processor_down_is_a_warning(
    root: Path, examine: Examine
) -> None:
    assert level(examine("governor")) == "skipped"
    for cpu in range(4):
        put(root, f"sys/devices/system/cpu/cpu{cpu}/cpufreq/scaling_governor", "performance\n")
    assert level(examine("governor")) == "ok"
    put(root, "sys/devices/system/cpu/cpu2/cpufreq/scaling_governor", "ondemand\n")
    assert level(examine("governor")) == "warning"


def test_a_clock_that_systemd_has_synchronised_is_well(root: Path, examine: Examine) -> None:
    put(root, "run/systemd/timesync/synchronized")
    assert level(examine("clock")) == "ok"


def test_why_nobody_can_see_who_uses_pins_is_told(root: Path, examine: Examine) -> None:
    def said() -> str:
        found = examine("gpio pins")
        assert level(found) == "skipped"
        assert found is not None
        return found.message

    if os.geteuid() != 0:
        assert "only root can see" in said()
        return
    (root / "sys/kernel/debug").mkdir(parents=True)
    assert "debugfs is not mounted: mount -t debugfs none /sys/kernel/debug" in said()
    put(root, "sys/kernel/debug/clk/clk_summary")
    assert "this kernel does not say who uses GPIO pins" in said()
    with unprivileged():
        assert "only root can see" in said()


def test_a_gpio_pin_of_somebody_else_is_a_warning(root: Path, examine: Examine) -> None:
    assert level(examine("gpio pins")) == "skipped"
    put(
        root,
        "sys/kernel/debug/gpio",
        "gpiochip0: GPIOs 512-565, parent: platform/fe200000.gpio, pinctrl-bcm2711:\n"
        " gpio-529 (GPIO17              )\n"
        " gpio-530 (GPIO18              |pps-gpio            ) in  lo\n"
        " gpio-539 (GPIO27              |sysfs               ) out lo\n",
    )
    found = examine("gpio pins")
    assert level(found) == "warning"
    assert found is not None
    assert found.message == "GPIO18 (servo.gpio) is used by pps-gpio"
    assert level(examine("gpio pins", "servo.gpio=17")) == "ok"
    assert level(examine("gpio pins", "servo.gpio=17", "panel.led_gpio=27")) == "warning"


def pwm_channel(root: Path) -> Path:
    """A Pi 5's channel of GPIO 18, exported."""
    chip = root / "sys/class/pwm/pwmchip2"
    device = root / "devices/1f00098000.pwm"
    device.mkdir(parents=True)
    chip.mkdir(parents=True)
    (chip / "device").symlink_to(device)
    for name in ("period", "duty_cycle", "enable"):
        put(chip, f"pwm2/{name}", "0\n")
    return chip / "pwm2"


def test_the_pwm_channel_must_be_there_and_silent(root: Path, examine: Examine) -> None:
    driver = "servo.driver=sysfs-pwm"
    assert examine("pwm") is None
    missing = examine("pwm", driver)
    assert level(missing) == "FAIL"
    channel = pwm_channel(root)
    assert level(examine("pwm", driver)) == "ok"
    (channel / "enable").write_text("1\n")
    (channel / "duty_cycle").write_text("1500000\n")
    left_on = examine("pwm", driver)
    assert level(left_on) == "warning"
    assert left_on is not None
    assert left_on.mend == "fishctl release"
    assert (channel / "duty_cycle").read_text() == "1500000\n"


def test_calibrations_are_asked_for_and_a_broken_file_fails(root: Path, examine: Examine) -> None:
    assert level(examine("calibrations")) == "warning"
    matrix = "{xx: 2.0, xy: 0.0, x0: 0.0, yx: 0.0, yy: 2.0, y0: 0.0, date: '2026-01-02'}\n"
    put(root, "state/pi/force-2026-01-02T000000.000000Z.yaml", matrix)
    found = examine("calibrations")
    assert level(found) == "warning"
    assert found is not None
    assert found.mend == "fishctl calibrate servo"
    pulses = "trim: 10.0, direction: 1, scale: 600.0, lowest: -1.0, highest: 1.0"
    put(
        root, "state/pi/servo-2026-01-03T000000.000000Z.yaml", f"{{{pulses}, date: '2026-01-03'}}\n"
    )
    assert examine("calibrations") == ("ok", "force of 2026-01-02, servo of 2026-01-03", "")
    backup = put(root, "state/pi/force-backup.yaml", matrix)
    ignored = examine("calibrations")
    assert level(ignored) == "warning"
    assert ignored is not None
    assert ignored.message == (
        "force of 2026-01-02, servo of 2026-01-03; "
        f"{backup} is no dated calibration file and is ignored"
    )
    backup.unlink()
    put(root, "state/pi/force-2026-02-02T000000.000000Z.yaml", "xx: a lot\n")
    assert level(examine("calibrations")) == "FAIL"


def test_a_force_that_was_only_tared_is_not_calibrated(root: Path, examine: Examine) -> None:
    matrix = "xx: 1.0, xy: 0.0, x0: 0.3, yx: 0.0, yy: 1.0, y0: 0.0"
    name = "state/pi/force-2026-01-02T000000.000000Z.yaml"
    put(root, name, f"{{{matrix}, date: '2026-01-02', tared: '2026-01-02'}}\n")
    found = examine("calibrations")
    assert level(found) == "warning"
    assert found is not None
    assert "tared 2026-01-02, but never calibrated" in found.message
    assert found.mend == "fishctl calibrate force"


def test_a_read_only_file_system_is_not_taken_for_a_permission(root: Path) -> None:
    (root / "state").mkdir()
    mount = 'mount -t tmpfs -o ro none "$0" && exec "$@"'
    apart = ["unshare", *([] if os.geteuid() == 0 else ["-r"]), "-m", "sh", "-c", mount]
    if subprocess.run([*apart, str(root / "state"), "true"], check=False).returncode:
        pytest.skip("needs a file system of its own")
    settings = ("--set", "robot=pi", "--set", f"state_folder={root}/state", *free_telemetry())
    _, found = doctor(root, *settings, under=(*apart, str(root / "state")))
    level, message = found["state folder"]
    assert level == "FAIL"
    assert f"{root}/state is on a read-only file system" in message


def test_the_state_folder_must_be_one_that_can_be_written_to(root: Path, examine: Examine) -> None:
    assert level(examine("state folder")) == "ok"
    assert not (root / "state").exists()
    put(root, "state", "a file")
    assert level(examine("state folder")) == "FAIL"


def test_the_unit_must_be_installed_and_enabled(root: Path, examine: Examine) -> None:
    assert level(examine("systemd")) == "skipped"
    (root / "run/systemd/system").mkdir(parents=True)
    assert level(examine("systemd")) == "warning"
    unit = put(root, "etc/systemd/system/fishd.service", "[Service]\n")
    not_enabled = examine("systemd")
    assert level(not_enabled) == "warning"
    assert not_enabled is not None
    assert "enable --now" in not_enabled.mend
    wants = root / "etc/systemd/system/multi-user.target.wants"
    wants.mkdir()
    (wants / "fishd.service").symlink_to(unit)
    assert level(examine("systemd")) == "ok"


def test_pins_are_used_without_a_package_for_them_only_in_vain(
    root: Path, examine: Examine
) -> None:
    assert examine("gpio package") is None
    assert level(examine("gpio package", "panel.estop_gpio=4")) == "ok"  # rpi-lgpio is here
