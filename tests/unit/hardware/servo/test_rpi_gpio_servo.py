"""Servo on software PWM: the real rpi-lgpio on emulated pins."""

import gc
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rigs.lgpio_module import EmulatedLgpio, Pins

from fishd.core.calibration import ServoCalibration
from fishd.core.clock import VirtualClock
from fishd.core.errors import ServoError, StartupError
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.hardware.servo.rpi_gpio import RpiGpio, RpiGpioSettings, pull_low

SETTINGS = RpiGpioSettings(gpio=18)


@pytest.fixture
def pins() -> Iterator[Pins]:
    pins = Pins()
    with EmulatedLgpio(pins):
        yield pins
        gc.collect()  # the destructor of a PWM must not run later


@pytest.fixture
def servo(pins: Pins) -> Iterator[CalibratedServo]:
    servo = open_servo()
    yield servo
    servo.close()


def open_servo(settings: RpiGpioSettings = SETTINGS, clock: Any = None) -> CalibratedServo:
    time = clock or VirtualClock()
    return CalibratedServo(RpiGpio, settings, ServoCalibration(), time, threaded=False, tick=0.05)


def width(pins: Pins, gpio: int = 18) -> float:
    """Return the pulse that a pin sends [µs]."""
    pwm = pins.lines[gpio].pwm
    return 0.0 if pwm is None else 1e4 * pwm[1] / pwm[0]


def test_an_angle_becomes_a_pulse(pins: Pins, servo: CalibratedServo) -> None:
    for angle, expected in ((0.5, 1800.0), (-0.5, 1200.0), (0.0, 1500.0)):
        servo.write(angle)
        assert width(pins) == pytest.approx(expected, abs=0.01)
        frequency, _ = pins.lines[18].pwm or (0.0, 0.0)
        assert frequency == 50.0


def test_at_a_higher_frequency_pulses_are_as_long(pins: Pins) -> None:
    fast = open_servo(RpiGpioSettings(gpio=4, frequency=200.0))
    fast.write(0.5)
    assert width(pins, 4) == pytest.approx(1800.0)
    assert pins.lines[4].pwm == (200.0, pytest.approx(36.0))
    fast.close()


def test_opening_claims_the_pin_low_without_pulses(pins: Pins, servo: CalibratedServo) -> None:
    assert pins.lines[18].is_output
    assert pins.lines[18].driven == 0
    assert pins.lines[18].pwm is None


def test_a_release_ends_pulses_and_a_write_begins_again(pins: Pins, servo: CalibratedServo) -> None:
    servo.write(0.5)
    servo.release()
    servo.release()
    # Not stopped: RPi.GPIO would start again at 1 kHz.
    assert pins.lines[18].pwm == (50.0, 0.0)
    servo.write(0.5)
    assert width(pins) == pytest.approx(1800.0)


def test_close_lets_the_last_pulse_end_and_gives_back_only_its_own_pin(pins: Pins) -> None:
    from RPi import GPIO

    clock = VirtualClock()
    servo = open_servo(clock=clock)
    GPIO.setup(23, GPIO.OUT, initial=GPIO.HIGH)
    servo.write(0.5)
    before = clock.now
    servo.close()
    servo.close()
    assert clock.now - before >= 0.02
    assert pins.lines[18].pwm is None
    assert not pins.lines[18].is_output
    assert pins.lines[23].is_output
    assert pins.lines[23].level() == 1


def test_a_pin_that_another_process_holds_is_an_error_until_it_is_free(pins: Pins) -> None:
    pins.lines[18].busy = True
    servo = open_servo()
    for _ in range(2):
        with pytest.raises(ServoError, match=r"^servo on GPIO 18: GPIO busy$"):
            servo.write(0.0)
    with pytest.raises(ServoError, match="GPIO busy"):
        pull_low(1500.0, gpio=18)
    servo.release()
    pins.lines[18].busy = False
    servo.write(0.0)
    assert width(pins) == pytest.approx(1500.0)
    servo.close()


def test_a_cleanup_of_all_pins_by_others_is_survived(pins: Pins, servo: CalibratedServo) -> None:
    from RPi import GPIO

    servo.write(0.5)
    GPIO.cleanup()
    with pytest.raises(ServoError, match=r"^servo on GPIO 18: "):
        servo.write(0.4)
    servo.write(0.4)
    assert width(pins) == pytest.approx(1740.0)
    assert servo.driver.counters() == {"servo_reconnects": 1}


def test_the_last_resort_leaves_the_pin_low(pins: Pins, servo: CalibratedServo) -> None:
    assert pull_low(1500.0, gpio=18) is False
    assert pins.lines[18].is_output
    assert pins.lines[18].level() == 0


def test_the_librarys_warnings_are_logged(pins: Pins, caplog: pytest.LogCaptureFixture) -> None:
    from fishd.hardware import header

    caplog.set_level("INFO")
    gpio = header.load()
    # rpi-lgpio warns of a pull-up on a pin that already has one.
    header.claim(gpio, 2, gpio.IN, pull_up_down=gpio.PUD_UP)
    assert caplog.messages == ["GPIO 2: A physical pull up resistor is fitted on this channel!"]
    with pytest.warns(Warning, match="physical pull up"):  # it stays on for other code
        gpio.setup(3, gpio.IN, pull_up_down=gpio.PUD_UP)
    gpio.cleanup([2, 3])


class TestALibraryThatCannotBeUsed:
    """Libraries that cannot be used: each case gives one line with the remedy."""

    def start(self) -> str:
        with pytest.raises(StartupError) as caught:
            open_servo()
        assert "\n" not in str(caught.value)
        return str(caught.value)

    def test_missing(self, pins: Pins, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "RPi", None)
        assert "install fishd[rpi-lgpio], or fishd[rpi-gpio] (Pi 4" in self.start()

    def test_twice(self, pins: Pins, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        info = tmp_path / "RPi_GPIO-0.7.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: RPi.GPIO\nVersion: 0.7.1\n")
        monkeypatch.syspath_prepend(tmp_path)
        assert self.start().startswith("RPi.GPIO and rpi-lgpio are both installed")

    def test_not_on_a_pi(self, pins: Pins, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delenv("RPI_LGPIO_REVISION")
        assert "This module can only be run on a Raspberry Pi" in self.start()

    def test_without_permission(self, pins: Pins) -> None:
        pins.present = False
        assert self.start() == (
            "the pins of the header cannot be used: can not open gpiochip; "
            "add the user of fishd to group gpio"
        )

    def test_in_a_folder_that_lgpio_may_not_write_to(
        self, pins: Pins, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        # On import, lgpio does this if it cannot make its pipe.
        (tmp_path / "lgpio.py").write_text("open('/nowhere/.lgd-nfy-3', 'rb')\n")
        monkeypatch.delitem(sys.modules, "lgpio")
        monkeypatch.syspath_prepend(tmp_path)
        assert self.start() == (
            "rpi-lgpio cannot make its pipe in the working folder: No such file or directory; "
            "start fishd in a folder that it may write to"
        )

    def test_numbered_otherwise_by_another_part(self, pins: Pins) -> None:
        from RPi import GPIO

        GPIO.setmode(GPIO.BOARD)
        assert "A different mode has already been set" in self.start()
