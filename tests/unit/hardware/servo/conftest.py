"""Emulated pigpiod in virtual time."""

from rigs.pigpio_rig import bench

__all__ = ["bench"]
