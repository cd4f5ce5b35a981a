"""Tests that start processes, wait for real time or load torch."""

from rigs.daemons import daemon, own_daemon, service, shared_daemon, unhurried_rig

__all__ = ["daemon", "own_daemon", "service", "shared_daemon", "unhurried_rig"]
