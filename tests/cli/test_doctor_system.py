"""What `fishctl doctor` makes of the Pi's model, system, bus and amplifier, on a tree of files."""

from pathlib import Path

import pytest
from doctor_tree import Examine, level, put


@pytest.mark.parametrize("folder", ["sys/bus/i2c/devices", "sys/class/i2c-adapter"])
@pytest.mark.parametrize(("speed", "expected"), [(400_000, "ok"), (100_000, "warning")])
def test_a_slow_bus_is_a_warning_on_kernels_old_and_new(
    root: Path, examine: Examine, folder: str, speed: int, expected: str
) -> None:
    assert level(examine("i2c speed")) == "skipped"
    put(root, f"{folder}/i2c-1/of_node/clock-frequency", speed.to_bytes(4, "big"))
    assert level(examine("i2c speed")) == expected


def test_where_the_bus_follows_the_core_clock_the_speed_is_said_to_be_set(
    root: Path, examine: Examine
) -> None:
    place = "sys/bus/i2c/devices/i2c-1/of_node/clock-frequency"
    put(root, place, (400_000).to_bytes(4, "big"))
    put(root, "proc/device-tree/model", "Raspberry Pi 5 Model B Rev 1.0\0")
    assert examine("i2c speed") == ("ok", "400 kbit/s", "")
    put(root, "proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.5\0")
    found = examine("i2c speed")
    assert level(found) == "ok"
    assert found is not None
    assert "less while this Pi's core clock is lowered" in found.message


def test_a_machine_that_is_no_raspberry_pi_is_pointed_out(root: Path, examine: Examine) -> None:
    assert level(examine("model")) == "warning"
    assert examine("system") is None
    put(root, "proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.5\0")
    put(root, "proc/device-tree/compatible", "raspberrypi,4-model-b\0brcm,bcm2711\0")
    assert examine("model") == ("ok", "Raspberry Pi 4 Model B Rev 1.5", "")


def test_a_pi_that_is_too_slow_is_refused(root: Path, examine: Examine) -> None:
    put(root, "proc/device-tree/model", "Raspberry Pi Zero W Rev 1.1\0")
    put(root, "proc/device-tree/compatible", "raspberrypi,model-zero-w\0brcm,bcm2835\0")
    found = examine("model")
    assert level(found) == "FAIL"
    assert found is not None
    assert "too slow" in found.message
    put(root, "proc/device-tree/model", "Raspberry Pi Zero 2 W Rev 1.0\0")
    put(root, "proc/device-tree/compatible", "raspberrypi,model-zero-2-w\0brcm,bcm2837\0")
    assert level(examine("model")) == "ok"


def a_pi(root: Path, model: str, kernel: str, *, raspberry_pi_os: bool) -> None:
    put(root, "proc/device-tree/model", f"{model}\0")
    put(root, "proc/sys/kernel/osrelease", f"{kernel}\n")
    put(root, "etc/os-release", 'PRETTY_NAME="Debian GNU/Linux 13 (trixie)"\nVERSION_ID="13"\n')
    if raspberry_pi_os:
        put(root, "etc/rpi-issue", "Raspberry Pi reference 2025-10-01\n")
        (root / "proc/device-tree/__overrides__").mkdir()


@pytest.mark.parametrize(
    ("driver", "lacks"),
    [("sysfs-pwm", "the PWM of the header is off"), ("pigpio", "there is no pigpiod")],
)
def test_plain_debian_on_a_pi_is_told_from_raspberry_pi_os(
    root: Path, examine: Examine, driver: str, lacks: str
) -> None:
    a_pi(root, "Raspberry Pi 4 Model B Rev 1.5", "6.12.43+deb13-arm64", raspberry_pi_os=False)
    found = examine("system", f"servo.driver={driver}")
    assert level(found) == "warning"
    assert found is not None
    assert found.message == (
        "Debian GNU/Linux 13 (trixie) with its own kernel, 6.12.43+deb13-arm64: "
        f"dtparam= and dtoverlay= in config.txt do nothing, {lacks}"
    )


def test_raspberry_pi_os_is_named_with_its_kernel(root: Path, examine: Examine) -> None:
    a_pi(root, "Raspberry Pi 4 Model B Rev 1.5", "6.12.47+rpt-rpi-v8", raspberry_pi_os=True)
    said = "Raspberry Pi OS (Debian GNU/Linux 13 (trixie)), kernel 6.12.47+rpt-rpi-v8"
    assert examine("system") == ("ok", said, "")


def test_a_kernel_that_does_not_know_the_header_of_a_pi_5_fails(
    root: Path, examine: Examine
) -> None:
    a_pi(root, "Raspberry Pi 5 Model B Rev 1.0", "6.12.43+deb13-arm64", raspberry_pi_os=False)
    found = examine("system")
    assert level(found) == "FAIL"
    assert found is not None
    assert "does not know the header of a Pi 5" in found.message
    put(root, "sys/bus/platform/devices/1f00074000.i2c/uevent")
    assert level(examine("system")) == "warning"


@pytest.mark.parametrize(
    ("place", "advice"),
    [
        ("usr/bin/pigpiod", "systemctl enable --now pigpiod"),
        ("etc/rpi-issue", "sudo apt install pigpio"),
        ("etc/debian_version", "Debian has no pigpiod"),
    ],
)
def test_where_nobody_answers_for_pigpiod_it_is_told_how_to_get_it_here(
    root: Path, examine: Examine, place: str, advice: str
) -> None:
    put(root, place)
    found = examine("pigpiod", "servo.pigpio.port=1")
    assert level(found) == "FAIL"
    assert found is not None
    assert advice in found.mend


def test_a_button_that_nothing_can_read_is_not_passed_over(
    examine: Examine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The installation goes on without its package, and nobody may take that for a working one."""
    monkeypatch.setattr("fishd.cli.checks.software.metadata.distributions", lambda: iter(()))
    assert examine("gpio package") is None
    found = examine("gpio package", "panel.estop_gpio=17")
    assert level(found) == "FAIL"
    assert found is not None
    assert found.message.startswith("neither RPi.GPIO nor rpi-lgpio is installed")
    assert "make install-pi" in found.mend


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (["full_scale=2.048"], "ok"),
        (["full_scale=4.096"], "ok"),
        (["full_scale=4.096", "saturation_high=null"], "warning"),
        (["channel_x=A0", "channel_y=A1"], "warning"),
        (["channel_x=A0", "channel_y=A1", "saturation_low=0.1"], "ok"),
    ],
)
def test_an_amplifier_whose_end_would_pass_for_a_force_is_a_warning(
    examine: Examine, settings: list[str], expected: str
) -> None:
    assert level(examine("amplifier", *(f"force_sensor.{key}" for key in settings))) == expected
