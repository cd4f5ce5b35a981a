"""The seam between the loop and any fish: protocols, and the robot that joins them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.signals import Measurement, Truth

if TYPE_CHECKING:
    from fishd.hardware.force_sensor.window import VoltageWatch
    from fishd.hardware.panel import RpiGpioPanel
    from fishd.hardware.servo.calibrated_servo import CalibratedServo


class ForceSensor(Protocol):
    """The dual force sensor."""

    def read(self, now: float) -> Measurement:
        """What was measured since the previous read; never blocks.

        `now` is the start of the tick [s, monotonic]. Raises `SensorError` where there is
        nothing to trust.
        """

    def close(self) -> None:
        """Let go of the sensor; may be called twice."""


class TaredSensor(Protocol):
    """A force sensor whose zero can be set."""

    calibration: ForceCalibration
    """What turns what it senses into forces."""

    @property
    def unit(self) -> str:
        """Of the forces: `N`, or that of the driver until the sensor is calibrated."""

    def recalibrate(self, calibration: ForceCalibration) -> None:
        """Use another calibration from the next read on."""

    def watch(self) -> "VoltageWatch":
        """Begin to add up what it senses from now on."""


class Servo(Protocol):
    """The tail servo."""

    def write(self, angle: float) -> None:
        """Send an instruction angle [rad], and with it pulses if there were none.

        Raises `ServoError` when the servo cannot be reached.
        """

    def release(self) -> None:
        """Stop the pulses, so that the servo holds no torque; may be called twice.

        Raises `ServoError` when the servo cannot be reached.
        """

    def close(self) -> None:
        """Release the servo and let go of it; may be called twice."""


@dataclass(frozen=True)
class Robot:
    """All that the loop reads from and writes to."""

    name: str
    sensor: ForceSensor
    servo: Servo
    truth: Callable[[], Truth] | None = None
    """The true state at the latest read, where the fish is simulated."""
    panel: "RpiGpioPanel | None" = None
    tared: TaredSensor | None = None
    """The force sensor, where it can be tared."""
    calibrated: "CalibratedParts | None" = None
    """What can be calibrated; None for a simulated fish, whose forces can only be tared."""
    degraded: Callable[[], tuple[str, ...]] = tuple
    """What keeps this robot from being as good as it could be now, a line each."""
    counters: Callable[[], dict[str, int]] = dict
    """Errors that were survived, such as failed I2C transfers, since start."""
    power: Callable[[float], float] | None = None
    """Mean electrical power of the servo since it was asked last [W]; None without a power meter.

    Asked after each read of the sensor with the start of the tick [s, monotonic]; never blocks.
    Raises `SensorError` where it is not known.
    """
    countdown: float = math.inf
    """As `ServoDriver.countdown` [s]."""

    @property
    def force_unit(self) -> str:
        """`N`; that of the sensor's driver where it was never calibrated."""
        return self.tared.unit if self.tared else "N"


@dataclass(frozen=True)
class CalibratedParts:
    """A robot's sensor and servo as what can be calibrated."""

    sensor: TaredSensor
    servo: "CalibratedServo"
    recalibrated: Callable[[ServoCalibration], None] = lambda calibration: None
    """Called when another calibration of the servo applies."""
