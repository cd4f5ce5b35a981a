"""Interface between the loop and any fish: protocols, and the robot that joins them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.signals import Measurement, Truth

if TYPE_CHECKING:
    from fishd.hardware.force_sensor.window import VoltageWatch
    from fishd.hardware.panel import Panel
    from fishd.hardware.servo.calibrated_servo import CalibratedServo


class ForceSensor(Protocol):
    """The dual force sensor."""

    def read(self, now: float) -> Measurement:
        """Return the measurement since the previous read; never blocks.

        `now` is the start of the tick [s, monotonic]. Raises `SensorError` if no measurement can
        be trusted.
        """

    def close(self) -> None:
        """Close the sensor; may be called twice."""


class TaredSensor(Protocol):
    """A force sensor whose zero can be set."""

    calibration: ForceCalibration
    """Calibration that turns the sensor's values into forces."""

    @property
    def unit(self) -> str:
        """Unit of the forces: `N`, or that of the driver until the sensor is calibrated."""

    def recalibrate(self, calibration: ForceCalibration) -> None:
        """Use another calibration from the next read on."""

    def watch(self) -> "VoltageWatch":
        """Return a watch that adds up the sensor's values from now on."""


class Servo(Protocol):
    """The tail servo."""

    def write(self, instruction_angle: float) -> None:
        """Send an instruction angle [rad]; start the pulses if there are none.

        Raises `ServoError` when the servo cannot be reached.
        """

    def release(self) -> None:
        """Stop the pulses, so that the servo holds no torque; may be called twice.

        Raises `ServoError` when the servo cannot be reached.
        """

    def close(self) -> None:
        """Release and close the servo; may be called twice."""


@dataclass(frozen=True)
class Robot:
    """All that the loop reads from and writes to."""

    name: str
    sensor: ForceSensor
    servo: Servo
    truth: Callable[[], Truth] | None = None
    """Function that returns the true state at the latest read, if the fish is simulated."""
    panel: "Panel | None" = None
    tared: TaredSensor | None = None
    """The force sensor, if it can be tared."""
    calibrated: "CalibratedParts | None" = None
    """Parts that can be calibrated; None for a simulated fish, whose forces can only be tared."""
    limitations: Callable[[], tuple[str, ...]] = tuple
    """Reasons why this robot is not as good as it could be now, a line each."""
    counters: Callable[[], dict[str, int]] = dict
    """Numbers of recovered errors since start, such as failed I2C transfers."""
    power: Callable[[float], float] | None = None
    """Mean electrical power of the servo since the previous call [W]; None without a power meter.

    Called after each read of the sensor with the start of the tick [s, monotonic]; never blocks.
    Raises `SensorError` if the power is not known.
    """
    prepare: Callable[[], None] = lambda: None
    """Called between the ticks of a loop in real time, just before the next read."""
    countdown: float = math.inf
    """Time for which the servo continues without a write [s]; see `ServoDriver.countdown`."""
    write_recipes: Callable[[Path], None] = lambda control: None
    """Writes again how other programs end the pulses, after the runtime folder was gone.

    Called with the file of the control socket.
    """

    @property
    def force_unit(self) -> str:
        """Unit of the forces: `N`, or that of the driver if the sensor was never calibrated."""
        return self.tared.unit if self.tared else "N"


@dataclass(frozen=True)
class CalibratedParts:
    """The sensor and the servo of a robot that can be calibrated."""

    sensor: TaredSensor
    servo: "CalibratedServo"
    recalibrated: Callable[[ServoCalibration], None] = lambda calibration: None
    """Called when another calibration of the servo applies."""
