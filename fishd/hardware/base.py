"""The seam between the loop and any fish: two protocols and the robot that joins them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from fishd.signals import Measurement, Truth


class ForceSensor(Protocol):
    """The dual force sensor."""

    def read(self, now: float) -> Measurement:
        """What was measured since the previous read; never blocks.

        `now` is the start of the tick [s, monotonic]. Raises `SensorError` where there is
        nothing to trust.
        """

    def close(self) -> None:
        """Let go of the sensor; may be called twice."""


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
