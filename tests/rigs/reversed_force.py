"""Robot with reversed F_y."""

import dataclasses

from msgspec.structs import replace

from fishd.core.signals import Measurement
from fishd.hardware.base import ForceSensor, Robot


class ReversedSensor:
    """Force sensor with interchanged wires of F_y."""

    def __init__(self, sensor: ForceSensor) -> None:
        self._sensor = sensor

    def read(self, now: float) -> Measurement:
        """Read the sensor, with F_y reversed."""
        measurement = self._sensor.read(now)
        return replace(measurement, fy=-measurement.fy)

    def close(self) -> None:
        """Close the sensor."""
        self._sensor.close()


def reversed_robot(robot: Robot) -> Robot:
    """Return the robot with its F_y reversed."""
    return dataclasses.replace(robot, sensor=ReversedSensor(robot.sensor))
