"""Channel of the kernel's PWM for the servo: search, wait for udev, loss and return."""

from typing import Any

import pytest
from rigs.sysfs_pwm_rig import FAN, PI4, PI5, Bench

from fishd.core.errors import ServoError
from fishd.hardware.servo.sysfs_pwm import SysfsPwmSettings


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize(
    ("chips", "settings", "device", "channel"),
    [
        ({FAN: 4, PI5: 4}, {"gpio": 18}, PI5, 2),
        ({PI5: 4, FAN: 4}, {"gpio": 19}, PI5, 3),
        ({PI5: 4}, {"gpio": 13}, PI5, 1),
        ({PI4: 2}, {"gpio": 18}, PI4, 0),
        ({PI4: 2}, {"gpio": 13}, PI4, 1),
        ({"3f20c000.pwm": 2}, {"gpio": 12}, "3f20c000.pwm", 0),
        ({PI5: 4, "soc:pwm": 1}, {"gpio": 4, "chip": "soc:pwm", "channel": 0}, "soc:pwm", 0),
    ],
)
def test_the_chip_is_found_by_its_device_or_name_whatever_its_number(
    chips: dict[str, int], settings: dict[str, Any], device: str, channel: int
) -> None:
    bench = Bench(chips)
    bench.servo(SysfsPwmSettings(**settings)).write(0.0)
    bench.clock.sleep(0.02)
    assert bench.width(channel, device) == 1500.0


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


def test_an_unexported_channel_is_an_error_and_then_opened_again(bench: Bench) -> None:
    servo = bench.servo()
    bench.write(servo, 0.2)
    bench.shell("pwmchip1/unexport", 2)
    with pytest.raises(ServoError, match=r"pwm2/enable is gone"):
        servo.write(0.2)
    assert servo.driver.counters() == {"servo_reconnects": 0}
    with pytest.raises(ServoError):
        servo.write(0.2)  # exported again, but udev has not made it writable yet
    bench.clock.sleep(0.05)
    assert bench.write(servo, 0.2) == 1620.0
    assert servo.driver.counters() == {"servo_reconnects": 1}


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


@pytest.mark.parametrize(
    ("chips", "settings", "message"),
    [
        ({FAN: 4}, SysfsPwmSettings(), r"add dtoverlay=pwm-2chan to /boot/firmware/config.txt"),
        ({}, SysfsPwmSettings(gpio=12), r"has none: add dtoverlay=pwm-2chan,pin=12,func=4,pin2=13"),
        ({PI5: 4}, SysfsPwmSettings(gpio=17), r"^servo.gpio: GPIO 17 .*; 12, 13, 18, 19 have$"),
        ({FAN: 4}, SysfsPwmSettings(chip=FAN), r"^servo.channel is missing: for chip 1f0009c000"),
        ({PI5: 4}, SysfsPwmSettings(channel=4), r"^servo.channel: .*/pwmchip0 has no channel 4$"),
        (
            {PI5: 4},
            SysfsPwmSettings(root="/nowhere"),
            r"^no PWM chips can be found in /nowhere: No",
        ),
    ],
)
def test_a_mistake_is_named_with_what_would_be_right(
    chips: dict[str, int], settings: SysfsPwmSettings, message: str
) -> None:
    bench = Bench(chips)
    servo = bench.servo(settings)
    with pytest.raises(ServoError, match=message) as caught:
        servo.write(0.0)
    assert "\n" not in str(caught.value)
    with pytest.raises(ServoError):
        bench.last_resort(settings=settings)


def test_a_channel_that_the_kernel_uses_itself_is_refused(bench: Bench) -> None:
    bench.kernel.take(PI5, 2)
    servo = bench.servo()
    with pytest.raises(ServoError, match=r"channel 2 of .* is in use by a driver of the kernel"):
        servo.write(0.0)


def test_a_channel_that_others_have_inverted_gets_its_normal_polarity_back() -> None:
    bench = Bench()
    channel = leave_inverted(bench)
    servo = bench.servo()
    assert bench.write(servo, 0.5) == 1800
    assert bench.kernel.pulses(PI5, channel).level(bench.clock.now + 0.0007) == 1
    servo.release()
    bench.clock.sleep(0.05)
    assert bench.width() == 0


def test_the_last_resort_brings_an_inverted_servo_to_neutral_too() -> None:
    bench = Bench()
    leave_inverted(bench)
    assert bench.last_resort() is True
    assert max(bench.widths()) == 18_200  # and never high permanently
    assert bench.widths()[-2:] == [1500, 0]
    assert bench.last_resort() is False


def leave_inverted(bench: Bench) -> int:
    """Make pulses of 18.2 ms, inverted pulses of 1.8 ms; return the number of the channel."""
    bench.shell("pwmchip1/export", 2)
    bench.clock.sleep(0.1)
    for name, value in (("period", 20_000_000), ("polarity", "inversed")):
        bench.shell(f"pwmchip1/pwm2/{name}", value)
    for name, value in (("duty_cycle", 1_800_000), ("enable", 1)):
        bench.shell(f"pwmchip1/pwm2/{name}", value)
    bench.clock.sleep(0.05)
    assert bench.width() == 18_200
    return 2
