"""Interface between the loop and any fish: protocols, and the robot that joins them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.schema import Reading
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


class Sensor(Protocol):
    """Any other sensor, which is sampled outside of the ticks."""

    @property
    def name(self) -> str:
        """Name in the configuration."""

    @property
    def declared(self) -> Mapping[str, Reading]:
        """Readings of the sensor by name."""

    @property
    def required(self) -> bool:
        """Whether a reading that is old is a fault."""

    @property
    def stale_after(self) -> float:
        """Age from which a reading is old [s]."""

    @property
    def doubts(self) -> Mapping[str, str]:
        """Reasons why readings are doubtful, by name; never changed in place."""

    @property
    def trouble(self) -> str | None:
        """Reason why the latest attempt to sample failed, one line; None if it did not."""

    def read(self) -> Mapping[str, tuple[float, float]]:
        """Return time [s, monotonic] and value of each reading that is known; never waits.

        The mapping never changes. A sensor without a thread takes a sample first, if one is due.
        """


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
    sensors: "tuple[Sensor, ...]" = ()
    """Other sensors, whose readings each tick takes after the read of the force sensor."""
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
