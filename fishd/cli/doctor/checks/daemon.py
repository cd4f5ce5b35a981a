"""Asks the daemon what it says; one that cannot be asked is told from one that is not there."""

import os
import socket
from typing import NamedTuple

import msgspec

from fishd.client import Fish
from fishd.core.addresses import find_control, socket_path
from fishd.core.errors import FishError, NoDaemon, Refused, Untrusted
from fishd.core.protocol import Calibrations
from fishd.core.signals import Status, Tick
from fishd.core.unix_sockets import is_deserted

PATIENCE = 1.0
"""How long a daemon may take to answer [s]."""


class Running(NamedTuple):
    """What a running daemon says."""

    status: Status
    tick: Tick | None
    """The latest; None where telemetry is silent."""
    calibrations: Calibrations | None
    """None for a robot that has none."""
    endpoint: str


class Unreachable(NamedTuple):
    """Something is at the endpoint, perhaps a fishd that owns the hardware, but does not answer."""

    why: str
    forbidden: bool
    """It is this user who may not ask."""


def ask(endpoint: str | None) -> Running | Unreachable | None:
    """What the daemon at an endpoint says; None where it is certain that nobody listens there.

    A fishd at another control.address cannot be known, even if it owns the same bus.
    """
    named, endpoint = endpoint, endpoint or find_control()
    try:
        if _is_nobody_at(endpoint):
            return None
    except PermissionError:
        return Unreachable(f"there may be a fishd at {endpoint}, but this user may not ask", True)
    try:
        with Fish(named, timeout=PATIENCE) as fish:
            return Running(fish.status(), _latest_tick(fish), _calibrations(fish), endpoint)
    except Untrusted as error:
        why = str(error)
    except NoDaemon:
        why = f"no answer from {endpoint} within {PATIENCE:g} s, but a fishd may be there"
    except (FishError, msgspec.MsgspecError) as error:
        why = f"what answers at {endpoint} is no fishd of this version: {error}"
    return Unreachable(why, False)


def _is_nobody_at(endpoint: str) -> bool:
    """True where it is certain; raises PermissionError where this user cannot know."""
    path = socket_path(endpoint)
    if path is None:
        return _is_refused(endpoint)
    if is_deserted(path):
        return True
    if not os.access(path, os.W_OK):
        raise PermissionError
    return False


def _is_refused(endpoint: str) -> bool:
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), PATIENCE).close()
    except ConnectionRefusedError:
        return True
    except (OSError, ValueError):
        return False
    return False


def _latest_tick(fish: Fish) -> Tick | None:
    try:
        return next(fish.ticks())
    except FishError:
        return None


def _calibrations(fish: Fish) -> Calibrations | None:
    try:
        return fish.calibrations()
    except Refused:
        return None
