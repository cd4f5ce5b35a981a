"""A kernel's PWM in memory, and servos on it, for tests to drive and disturb."""

import math
import os

from sysfs_pwm_kernel import SysfsPwm

from fishd.clock import VirtualClock
from fishd.hardware.calibration import ServoCalibration
from fishd.hardware.settings import ServoSettings
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

    def shell(self, path: str, value: int | str) -> None:
        """`echo value > /sys/class/pwm/path`, by somebody else."""
        fd = self.kernel.open(f"/sys/class/pwm/{path}", os.O_WRONLY)
        self.kernel.pwrite(fd, f"{value}\n".encode(), 0)
        self.kernel.close(fd)

    def exported(self, chip: int = 1) -> list[str]:
        names = self.kernel.listdir(f"/sys/class/pwm/pwmchip{chip}")
        return [name for name in names if name.startswith("pwm")]
