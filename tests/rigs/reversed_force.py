"""A robot whose F_y has the wrong sign."""

import dataclasses

from msgspec.structs import replace

from fishd.core.signals import Measurement
from fishd.hardware.base import ForceSensor, Robot


class Interchanged:
    """A force sensor whose wires of F_y are interchanged."""

    def __init__(self, sensor: ForceSensor) -> None:
        self._sensor = sensor

    def read(self, now: float) -> Measurement:
        measured = self._sensor.read(now)
        return replace(measured, fy=-measured.fy)

    def close(self) -> None:
        self._sensor.close()


def reversed_robot(robot: Robot) -> Robot:
    return dataclasses.replace(robot, sensor=Interchanged(robot.sensor))
