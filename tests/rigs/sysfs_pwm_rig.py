"""PWM of a kernel in memory, and servos on it."""

import math
import os
from functools import partial

from fishd.core.calibration import ServoCalibration
from fishd.core.clock import VirtualClock
from fishd.hardware.servo import pwm_pulses
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.hardware.servo.sysfs_pwm import SysfsPwm, SysfsPwmSettings
from rigs.sysfs_pwm_kernel import SysfsPwm as SysfsPwmKernel

PI5 = "1f00098000.pwm"
FAN = "1f0009c000.pwm"
PI4 = "fe20c000.pwm"


class Bench:
    """Kernel of a Pi 5 or another machine, and servos on it."""

    def __init__(self, chips: dict[str, int] | None = None, udev_delay: float = 0.03) -> None:
        self.clock = VirtualClock()
        self.kernel = SysfsPwmKernel(
            self.clock, {FAN: 4, PI5: 4} if chips is None else chips, udev_delay=udev_delay
        )

    def servo(
        self, settings: SysfsPwmSettings | None = None, calibration: ServoCalibration | None = None
    ) -> CalibratedServo:
        return CalibratedServo(
            partial(SysfsPwm, files=self.kernel),  # type: ignore[arg-type]
            settings or SysfsPwmSettings(),
            calibration or ServoCalibration(),
            self.clock,
            threaded=False,
            tick=0.05,
        )

    def last_resort(
        self, neutral: float = 1500.0, settings: SysfsPwmSettings | None = None
    ) -> bool:
        """Run the last resort, as another process does when fishd is dead."""
        resort = SysfsPwm.last_resort(settings or SysfsPwmSettings())
        means = {"files": self.kernel, "clock": self.clock}
        return pwm_pulses.neutralise(neutral, **means, **resort.arguments)

    def write(self, servo: CalibratedServo, angle: float) -> float:
        """Write, wait for the next frame, and return its pulse [µs]."""
        servo.write(angle)
        self.clock.sleep(0.05)
        return self.width()

    def go_into_a_pulse(self) -> None:
        """Advance to the begin of a frame, where the level is high."""
        self.clock.now = math.ceil(self.clock.now / 0.02) * 0.02 + 0.0007

    def width(self, channel: int = 2, device: str = PI5) -> float:
        return self.kernel.pulses(device, channel).width(self.clock.now)

    def widths(self, channel: int = 2, device: str = PI5) -> list[float]:
        return [width for _, width in self.kernel.pulses(device, channel).history]

    def shell(self, path: str, value: int | str) -> None:
        """Run `echo value > /sys/class/pwm/path` as another program."""
        fd = self.kernel.open(f"/sys/class/pwm/{path}", os.O_WRONLY)
        self.kernel.pwrite(fd, f"{value}\n".encode(), 0)
        self.kernel.close(fd)

    def exported(self, chip: int = 1) -> list[str]:
        names = self.kernel.listdir(f"/sys/class/pwm/pwmchip{chip}")
        return [name for name in names if name.startswith("pwm")]
