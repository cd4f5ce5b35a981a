"""The servo on the kernel's PWM: right order, late permissions, leftovers, errors, last resort."""

import math
import os
from pathlib import Path

import pytest

from fishd.clock import VirtualClock
from fishd.emulation.sysfs_pwm import SysfsPwm
from fishd.errors import ServoError
from fishd.hardware.calibration import ServoCalibration
from fishd.hardware.settings import ServoSettings, SysfsPwmSettings
from fishd.hardware.sysfs_pwm import SysfsPwmServo

PI5 = "1f00098000.pwm"
FAN = "1f0009c000.pwm"
PI4 = "fe20c000.pwm"


class Bench:
    """A Pi 5's kernel, or another one's, and servos on it."""

    def __init__(self, chips: dict[str, int] | None = None, udev_delay: float = 0.03) -> None:
        self.clock = VirtualClock()
        self.kernel = SysfsPwm(self.clock, chips or {FAN: 4, PI5: 4}, udev_delay=udev_delay)

    def servo(
        self, settings: ServoSettings | None = None, calibration: ServoCalibration | None = None
    ) -> SysfsPwmServo:
        return SysfsPwmServo(
            settings or ServoSettings(driver="sysfs-pwm"),
            calibration or ServoCalibration(),
            self.clock,
            self.kernel,
        )

    def write(self, servo: SysfsPwmServo, angle: float) -> float:
        """Write and wait for the next frame; the pulse that is sent then [µs]."""
        servo.write(angle)
        self.clock.sleep(0.05)
        return self.width()

    def go_into_a_pulse(self) -> None:
        """On to where a frame has just begun, and the level is high."""
        self.clock.now = math.ceil(self.clock.now / 0.02) * 0.02 + 0.0007

    def width(self, channel: int = 2, device: str = PI5) -> float:
        return self.kernel.pulses(device, channel).width(self.clock.now)

    def widths(self, channel: int = 2, device: str = PI5) -> list[float]:
        return [width for _, width in self.kernel.pulses(device, channel).history]

    def shell(self, path: str, value: int) -> None:
        """`echo value > /sys/class/pwm/path`, by somebody else."""
        fd = self.kernel.open(f"/sys/class/pwm/{path}", os.O_WRONLY)
        self.kernel.pwrite(fd, b"%d\n" % value, 0)
        self.kernel.close(fd)

    def exported(self, chip: int = 1) -> list[str]:
        names = self.kernel.listdir(f"/sys/class/pwm/pwmchip{chip}")
        return [name for name in names if name.startswith("pwm")]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_an_angle_becomes_a_pulse_on_the_channel_of_its_pin(bench: Bench) -> None:
    servo = bench.servo()
    assert bench.write(servo, 0.5) == pytest.approx(1800.0)
    assert bench.write(servo, -0.5) == pytest.approx(1200.0)
    servo.close()


def test_opening_moves_nothing(bench: Bench) -> None:
    servo = bench.servo()
    bench.clock.sleep(1.0)
    assert bench.widths() == []
    servo.close()
    assert bench.exported() == []


@pytest.mark.parametrize("frequency", [50.0, 100.0, 333.0])
def test_pulses_come_at_the_configured_frequency(bench: Bench, frequency: float) -> None:
    servo = bench.servo(ServoSettings(driver="sysfs-pwm", frequency=frequency))
    assert bench.write(servo, 1.2) == pytest.approx(2220.0)
    assert bench.kernel.pulses(PI5, 2).at(bench.clock.now).frame == pytest.approx(1 / frequency)
    servo.close()


@pytest.mark.parametrize(
    ("chips", "gpio", "device", "channel"),
    [
        ({FAN: 4, PI5: 4}, 18, PI5, 2),
        ({PI5: 4, FAN: 4}, 19, PI5, 3),
        ({PI5: 4}, 13, PI5, 1),
        ({PI4: 2}, 18, PI4, 0),
        ({PI4: 2}, 13, PI4, 1),
        ({"3f20c000.pwm": 2}, 12, "3f20c000.pwm", 0),
    ],
)
def test_the_chip_is_found_by_its_device_whatever_its_number(
    chips: dict[str, int], gpio: int, device: str, channel: int
) -> None:
    bench = Bench(chips)
    servo = bench.servo(ServoSettings(driver="sysfs-pwm", gpio=gpio))
    servo.write(0.0)
    bench.clock.sleep(0.02)
    assert bench.width(channel, device) == 1500.0
    servo.close()


def test_chip_and_channel_can_be_named() -> None:
    bench = Bench({PI5: 4, "soc:pwm": 1})
    named = SysfsPwmSettings(chip="soc:pwm", channel=0)
    servo = bench.servo(ServoSettings(driver="sysfs-pwm", gpio=4, sysfs=named))
    servo.write(0.0)
    bench.clock.sleep(0.02)
    assert bench.width(0, "soc:pwm") == 1500.0
    servo.close()


def test_a_start_waits_for_udev_but_a_tick_does_not() -> None:
    bench = Bench(udev_delay=1.5)
    servo = bench.servo()
    assert 1.5 <= bench.clock.now < 1.6
    servo.write(0.0)
    bench.shell("pwmchip1/unexport", 2)
    with pytest.raises(ServoError):
        servo.write(0.0)
    before = bench.clock.now
    with pytest.raises(ServoError, match=r"pwm2/period may not be used .* group gpio"):
        servo.write(0.0)
    assert bench.clock.now == before
    bench.clock.sleep(1.6)
    assert bench.write(servo, 0.0) == 1500.0
    servo.close()


def test_permissions_that_never_come_are_an_error_of_each_write() -> None:
    bench = Bench(udev_delay=1e6)
    servo = bench.servo()
    assert bench.clock.now == pytest.approx(2.0, abs=0.02)
    for _ in range(2):
        with pytest.raises(ServoError, match="udev rule"):
            servo.write(0.0)
    servo.close()  # without a word: there never were pulses
    assert bench.exported() == []


def test_release_ends_the_last_pulse_and_write_begins_again(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.3)
    bench.go_into_a_pulse()
    servo.release()
    servo.release()
    bench.clock.sleep(0.02)
    assert bench.width() == 0.0
    bench.write(servo, 0.1)
    servo.close()
    assert set(bench.widths()) == {0.0, 1680.0, 1560.0}


def test_close_switches_the_channel_off_and_gives_it_back(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.3)
    bench.go_into_a_pulse()
    servo.close()
    servo.close()
    assert bench.widths() == [1680.0, 0.0]  # and no shorter one between
    assert bench.exported() == []


def test_what_a_killed_fishd_left_behind_is_taken_over(bench: Bench) -> None:
    killed = bench.servo(ServoSettings(driver="sysfs-pwm", frequency=100.0))
    bench.write(killed, 0.4)
    servo = bench.servo()
    assert bench.width() == 1740.0  # opening changes nothing
    assert bench.write(servo, 0.0) == 1500.0
    assert bench.kernel.pulses(PI5, 2).at(bench.clock.now).frame == 0.02
    servo.close()
    assert bench.exported() == []


def test_a_release_stops_pulses_that_a_killed_fishd_left_behind(bench: Bench) -> None:
    bench.write(bench.servo(), 0.4)
    servo = bench.servo()
    servo.release()
    bench.clock.sleep(0.02)
    assert bench.width() == 0.0
    servo.close()


def test_a_channel_that_the_kernel_only_believes_to_be_on_gets_pulses(bench: Bench) -> None:
    careless = bench.servo()
    bench.write(careless, 0.0)
    bench.shell("pwmchip1/unexport", 2)
    bench.clock.sleep(0.1)
    assert bench.width() == 0.0
    servo = bench.servo()
    assert bench.write(servo, 0.0) == 1500.0
    servo.close()


def test_an_unexported_channel_is_an_error_and_then_opened_again(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.2)
    bench.shell("pwmchip1/unexport", 2)
    with pytest.raises(ServoError, match=r"pwm2/enable is gone"):
        servo.write(0.2)
    assert servo.counters() == {"servo_reconnects": 0}
    with pytest.raises(ServoError):
        servo.write(0.2)  # exported again, but udev has not seen it yet
    bench.clock.sleep(0.05)
    assert bench.write(servo, 0.2) == 1620.0
    assert servo.counters() == {"servo_reconnects": 1}
    servo.close()


def test_a_reloaded_driver_is_found_under_its_new_number(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.2)
    bench.kernel.unload(PI5)
    for _ in range(2):
        with pytest.raises(ServoError):
            servo.write(0.2)
    with pytest.raises(ServoError):
        servo.release()
    bench.kernel.load(PI5, 7)
    with pytest.raises(ServoError):
        servo.write(0.2)
    bench.clock.sleep(0.05)
    assert bench.write(servo, 0.2) == 1620.0
    servo.close()
    assert bench.exported(7) == []


def test_a_servo_that_is_not_there_at_start_is_found_later(bench: Bench) -> None:
    bench.kernel.unload(PI5)
    servo = bench.servo()
    with pytest.raises(ServoError, match=r"no PWM chip 1f00098000.pwm or .* has 1f0009c000.pwm"):
        servo.write(0.0)
    bench.kernel.load(PI5, 1)
    with pytest.raises(ServoError):
        servo.write(0.0)
    bench.clock.sleep(0.05)
    assert bench.write(servo, 0.0) == 1500.0
    servo.close()


@pytest.mark.parametrize(
    ("chips", "settings", "message"),
    [
        ({FAN: 4}, ServoSettings(), r"add dtoverlay=pwm-2chan to /boot/firmware/config.txt"),
        ({}, ServoSettings(gpio=12), r"has none: add dtoverlay=pwm-2chan,pin=12,func=4,pin2=13"),
        ({PI5: 4}, ServoSettings(gpio=17), r"^servo.gpio: GPIO 17 .*; 12, 13, 18, 19 have$"),
        (
            {FAN: 4},
            ServoSettings(sysfs=SysfsPwmSettings(chip=FAN)),
            r"^servo.sysfs.channel is missing: for chip 1f0009c000.pwm",
        ),
        (
            {PI5: 4},
            ServoSettings(sysfs=SysfsPwmSettings(channel=4)),
            r"^servo.sysfs.channel: /sys/class/pwm/pwmchip0 has no channel 4$",
        ),
        (
            {PI5: 4},
            ServoSettings(sysfs=SysfsPwmSettings(root="/sys/nowhere")),
            r"^no PWM chips can be found in /sys/nowhere: No such file",
        ),
    ],
)
def test_a_mistake_is_named_with_what_would_be_right(
    chips: dict[str, int], settings: ServoSettings, message: str
) -> None:
    bench = Bench()
    bench.kernel = SysfsPwm(bench.clock, chips)
    servo = bench.servo(settings)
    with pytest.raises(ServoError, match=message) as caught:
        servo.write(0.0)
    assert "\n" not in str(caught.value)
    with pytest.raises(ServoError):
        servo.neutralise()


def test_a_channel_that_the_kernel_uses_itself_is_refused(bench: Bench) -> None:
    bench.kernel.take(PI5, 2)
    servo = bench.servo()
    with pytest.raises(ServoError, match=r"channel 2 of .* is in use by a driver of the kernel"):
        servo.write(0.0)


def test_the_last_resort_moves_to_neutral_then_stops(bench: Bench) -> None:
    bench.write(bench.servo(), 0.5)  # of a fishd that was killed
    bench.go_into_a_pulse()
    begin = bench.clock.now
    rescue = bench.servo(calibration=ServoCalibration(trim=30.0))
    assert rescue.neutralise() is True
    rescue.close()
    assert bench.widths() == [1800.0, 1530.0, 0.0]
    neutral, off = (time for time, _ in bench.kernel.pulses(PI5, 2).history[1:])
    assert neutral - begin <= 0.02
    assert 0.28 <= off - neutral <= 0.32


def test_the_last_resort_leaves_a_servo_without_pulses_alone(bench: Bench) -> None:
    rescue = bench.servo()
    assert rescue.neutralise() is False
    rescue.close()
    assert bench.widths() == []
    assert bench.exported() == []


def test_a_living_fishd_notices_the_last_resort(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.5)
    rescue = bench.servo()
    assert rescue.neutralise() is True
    rescue.close()
    assert bench.exported() == ["pwm2"]  # fishd still holds it
    with pytest.raises(ServoError, match="switched off from outside"):
        servo.write(0.5)
    servo.close()


def test_close_goes_on_when_a_step_fails(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.5)
    bench.kernel.unload(PI5)
    bench.kernel.load(PI5, 1)
    with pytest.raises(ServoError):
        servo.close()
    assert bench.exported() == []
    servo.close()


def test_another_calibration_holds_from_the_next_write_on(bench: Bench) -> None:
    servo = bench.servo(calibration=ServoCalibration(trim=20.0, scale=500.0))
    assert bench.write(servo, 0.2) == 1620.0
    servo.recalibrate(ServoCalibration(direction=-1, highest=0.3))
    assert bench.write(servo, 0.2) == 1380.0
    assert servo.calibration.direction == -1
    with pytest.raises(ServoError, match="soft limits"):
        servo.write(0.4)
    assert bench.width() == 1380.0  # a bad angle is no lost servo
    servo.close()


def test_a_calibration_without_a_neutral_pulse_is_refused(bench: Bench) -> None:
    high = ServoSettings(driver="sysfs-pwm", centre=2400.0)
    servo = bench.servo(high)
    with pytest.raises(ServoError, match="2700 µs"):
        servo.recalibrate(ServoCalibration(trim=300.0))
    assert servo.calibration == ServoCalibration()
    servo.close()


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A folder of plain files with a channel that is exported already."""
    device = tmp_path / "devices" / PI5
    chip = device / "pwm" / "pwmchip3"
    channel = chip / "pwm2"
    channel.mkdir(parents=True)
    (chip / "device").symlink_to(device)
    for name in ("export", "unexport"):
        (chip / name).write_text("")
    for name in ("period", "duty_cycle", "enable"):
        (channel / name).write_text("0\n")
    root = tmp_path / "class"
    root.mkdir()
    (root / "pwmchip3").symlink_to(chip)
    return root


def number(path: Path) -> int:
    return int(path.read_text().split()[0])


def test_on_true_files_a_channel_is_driven_released_and_unexported(tree: Path) -> None:
    settings = ServoSettings(driver="sysfs-pwm", sysfs=SysfsPwmSettings(root=str(tree)))
    open_before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    servo = SysfsPwmServo(settings, ServoCalibration(), VirtualClock())
    channel = tree / "pwmchip3" / "pwm2"
    assert (channel / "enable").read_text() == "0\n"
    servo.write(1.0)
    assert [number(channel / n) for n in ("period", "duty_cycle", "enable")] == [
        20_000_000,
        2_100_000,
        1,
    ]
    servo.write(-1.0)
    assert number(channel / "duty_cycle") == 900_000
    servo.release()
    assert number(channel / "duty_cycle") == 0
    servo.close()
    assert number(channel / "enable") == 0
    assert (tree / "pwmchip3" / "unexport").read_text() == "2\n"
    assert len(os.listdir("/proc/self/fd")) == open_before  # noqa: PTH208


def test_on_true_files_an_empty_one_is_an_error(tree: Path) -> None:
    settings = ServoSettings(driver="sysfs-pwm", sysfs=SysfsPwmSettings(root=str(tree)))
    (tree / "pwmchip3" / "pwm2" / "enable").write_text("")
    servo = SysfsPwmServo(settings, ServoCalibration(), VirtualClock())
    with pytest.raises(ServoError, match="pwm2/enable does not contain a number"):
        servo.write(0.0)
