"""What all checks of `fishctl doctor` look at: configuration, machine, and a running fishd."""

import os
import shlex
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from fishd import assembly
from fishd.client import Fish
from fishd.client.connection import TIMEOUT
from fishd.config import Config
from fishd.config.drivers import CHOICES
from fishd.core.addresses import find_control, socket_path
from fishd.core.errors import FishError, NoDaemon, Refused, StartupError, Untrusted
from fishd.core.plugins import Plugins
from fishd.core.process.unix_sockets import is_deserted
from fishd.core.protocol import Calibrations
from fishd.core.signals import Status, Tick
from fishd.hardware import ownership
from fishd.hardware.checks import Machine, Result, skipped

INSTALL = f"{sys.executable} -m pip install 'fishd[pi]'"
"""Mends a missing driver."""
PATIENCE = TIMEOUT
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
        if is_nobody_at(endpoint):
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
    except FishError as error:
        why = str(error)
    return Unreachable(why, False)


def is_nobody_at(endpoint: str) -> bool:
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


@dataclass
class Context(Machine):
    """What the checks look at: this machine, the configuration and a daemon, if one runs."""

    config: Config
    file: Path | None = None
    """The configuration file; None for the defaults."""
    endpoint: str | None = None
    root: Path = field(default_factory=lambda: Path("/"))
    """Where /sys, /proc, /dev and so on are looked for."""

    @property
    def robot(self) -> str:
        """That of the configuration."""
        return self.config.robot

    @cached_property
    def daemon(self) -> Running | Unreachable | None:
        """What the daemon says, or why it cannot be asked; None where there certainly is none.

        That is about the endpoint: of a fishd at another one, `occupied` may know.
        """
        return ask(self.endpoint)

    @property
    def running(self) -> Running | None:
        """What the daemon of this robot says; None where none answers, or that of another robot."""
        found = self.daemon
        if isinstance(found, Running) and found.status.robot == self.config.robot:
            return found
        return None

    @cached_property
    def owner(self) -> str:
        """Which fishd, at whatever endpoint, drives a part of this robot; empty where none does."""
        try:
            return ownership.owner(assembly.parts_of(self.config))
        except StartupError:  # where a virtual Pi would be is no good place; the check will say so
            return ""

    def occupied(self, by_fishd: str) -> Result | None:
        """Why a check leaves the hardware alone; None where no fishd uses it.

        by_fishd: what to say of a running fishd
        """
        if isinstance(self.daemon, Unreachable):
            return skipped(f"{self.daemon.why}; {self.reach(self.daemon)}")
        if self.running:
            return skipped(f"fishd is running and {by_fishd}")
        if self.daemon:
            return skipped(
                f"the fishd at {self.daemon.endpoint} drives another robot, "
                f"{self.daemon.status.robot}; name this one's with --endpoint"
            )
        return skipped(f"{self.owner}; name it with --endpoint") if self.owner else None

    def reach(self, daemon: Unreachable) -> str:
        """What to do so that the daemon can be asked."""
        if daemon.forbidden:
            return f"{self.as_fishd}, or name another with --endpoint"
        return "stop what hangs there, or name the fishd with --endpoint"

    @property
    def as_fishd(self) -> str:
        """The command that makes these checks as the user of the service."""
        return self.as_user("fishd")

    def as_user(self, name: str) -> str:
        """The command that makes these checks as another user."""
        file = f" --config {self.file}" if self.file else ""
        return f"sudo -u {shlex.quote(name)} fishctl doctor{file}"

    @contextmanager
    def plugged_in(self) -> Iterator[None]:
        """Where the robot is a virtual Pi: with its bus in this process. Raises `StartupError`."""
        with ExitStack() as stack:
            if self.robot == "virtual-pi":
                assembly.plug_in_virtual_pi(self.config, stack)
            yield

    @property
    def drivers(self) -> tuple[tuple[str, Plugins[Any], Any], ...]:
        """Section, kind and settings of each driver: sensor, servo, and a power meter if any."""
        chosen = self.config.driver_settings.sections()
        return tuple((name, CHOICES[name].plugins, settings) for name, settings in chosen.items())


def sudo_unless(uid: int) -> str:
    """`sudo ` for a command that only this user, or root, may give; empty where that is us."""
    return "" if os.geteuid() in (0, uid) else "sudo "
