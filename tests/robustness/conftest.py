"""Tests of kills, floods, lost links, and damaged or hostile input."""

from rigs.daemons import daemon, own_daemon, shared_daemon, unhurried_rig
from rigs.pigpio_rig import bench

__all__ = ["bench", "daemon", "own_daemon", "shared_daemon", "unhurried_rig"]
