"""Context of all checks of `fishctl doctor`: configuration, machine, and a running fishd."""

import os
import shlex
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from fishd import assembly
from fishd.client import Fish
from fishd.client.connection import DEFAULT_TIMEOUT_S
from fishd.config import Config
from fishd.config.drivers import choice_of, name_of
from fishd.core import local_daemons
from fishd.core.addresses import find_control_address, socket_path
from fishd.core.errors import FishError, NoDaemon, Refused, StartupError, Untrusted
from fishd.core.local_daemons import LocalDaemon
from fishd.core.plugins import Plugins
from fishd.core.process.kernel_names import Holder
from fishd.core.process.unix_sockets import is_deserted
from fishd.core.protocol import Calibrations
from fishd.core.signals import Status, Tick
from fishd.hardware import ownership
from fishd.hardware.checks import Machine, Result, skipped

ANSWER_TIMEOUT_S = DEFAULT_TIMEOUT_S
"""Longest wait for an answer of a daemon [s]."""


class Running(NamedTuple):
    """State of a running daemon."""

    status: Status
    tick: Tick | None
    """Latest tick; None if telemetry is silent."""
    calibrations: Calibrations | None
    """Calibrations in use; None for a robot that has none."""
    endpoint: str
    detour: str
    """How it answered without its control socket; empty if it answered there."""


class Unreachable(NamedTuple):
    """Endpoint where a process, perhaps a fishd that owns the hardware, does not answer."""

    why: str
    forbidden: bool
    """Whether this user lacks the permission to connect."""
    remedy: str = ""
    """Remedy, if it is not the general one."""
    is_hung: bool = False
    """Whether it is certain that this is a fishd, which hangs or is stopped."""


def ask_daemon(endpoint: str | None) -> Running | Unreachable | None:
    """Return the state of the daemon at an endpoint; None if there certainly is none.

    Without an endpoint, a fishd of this user is found wherever its socket is. A fishd that serves
    another endpoint than the given one stays undetected, even if it owns the same bus.
    """
    given_endpoint, endpoint = endpoint, endpoint or find_control_address()
    forbidden, local = False, local_daemons.find_own(given_endpoint)
    try:
        if is_unused(endpoint) and not local:
            return None
    except PermissionError:
        forbidden = True
    try:
        with Fish(given_endpoint, timeout=ANSWER_TIMEOUT_S) as fish:
            status = fish.status()
            detour, where = fish.detour, status.control if fish.detour else endpoint
            return Running(status, _latest_tick(fish), _read_calibrations(fish), where, detour)
    except Untrusted as error:
        reason = str(error)
    except NoDaemon as error:
        reason = f"no answer from {endpoint} within {ANSWER_TIMEOUT_S:g} s"
        if forbidden:
            reason = f"there may be a fishd at {endpoint}, but this user may not ask"
        elif hung := local_daemons.find_silent(local):
            return Unreachable(*_describe_hung(reason, hung, given_endpoint), is_hung=True)
        elif local:
            remedy = "name the one that you mean with --endpoint"
            return Unreachable(str(error), False, remedy)
        else:
            reason += ", but a fishd may be there"
        return Unreachable(reason, forbidden)
    except FishError as error:
        reason = str(error)
    return Unreachable(reason, False)


def _describe_hung(
    reason: str, hung: list[LocalDaemon], endpoint: str | None
) -> tuple[str, bool, str]:
    """Return the fields of `Unreachable` for these; endpoint: the given one."""
    processes = " and ".join(f"process {Holder(daemon.pid, daemon.user)}" for daemon in hung)
    option = f" --endpoint {endpoint}" if endpoint else ""
    is_service = hung[0].user == local_daemons.service_user()
    sudo, pids = local_daemons.become(hung[0].user), " ".join(str(daemon.pid) for daemon in hung)
    restart = "sudo systemctl restart fishd" if is_service else f"kill -9 {pids}"
    return (
        f"{reason}: {processes}, a fishd, does not answer: it hangs or is stopped",
        False,
        f"'{sudo}fishctl estop{option}' ends its pulses; then: {restart}",
    )


def is_unused(endpoint: str) -> bool:
    """Return whether certainly no process listens at an endpoint.

    Raises PermissionError if this user cannot find out.
    """
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
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_TIMEOUT_S).close()
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


def _read_calibrations(fish: Fish) -> Calibrations | None:
    try:
        return fish.calibrations()
    except (Refused, NoDaemon):  # without a control socket there is no answer
        return None


class ChosenDriver(NamedTuple):
    """A driver that the configuration chooses."""

    section: str
    """Section of its keys, such as `servo` or `sensors.water`."""
    plugins: Plugins[Any]
    name: str
    settings: Any

    def find(self) -> Any:
        """Return its class; raise `UnknownDriver` if it does not load."""
        return self.plugins.find(self.name)


@dataclass
class Context(Machine):
    """Context of the checks: this machine, the configuration and a daemon, if one runs."""

    config: Config
    file: Path | None = None
    """Configuration file; None for the defaults."""
    endpoint: str | None = None
    root: Path = field(default_factory=lambda: Path("/"))
    """Folder that holds /sys, /proc, /dev and so on."""

    @property
    def is_virtual(self) -> bool:
        """Whether the hardware of the robot is a virtual Pi."""
        return self.config.kind.is_virtual

    @cached_property
    def daemon(self) -> Running | Unreachable | None:
        """State of the daemon, or why it does not answer; None if there certainly is none.

        This is the daemon at the endpoint; `occupied` may detect a fishd at another one.
        """
        return ask_daemon(self.endpoint)

    @property
    def running(self) -> Running | None:
        """State of the daemon of this robot; None if none answers, or one of another robot."""
        daemon = self.daemon
        if isinstance(daemon, Running) and daemon.status.robot == self.config.robot:
            return daemon
        return None

    @property
    def limitations(self) -> tuple[str, ...]:
        """Limitations that a running fishd of this robot reports; empty if none runs."""
        return self.running.status.limitations if self.running else ()

    @cached_property
    def owner(self) -> str | None:
        """Description of the fishd that drives a part of this robot, at any endpoint; or None."""
        try:
            return ownership.describe_owner(assembly.parts_of(self.config))
        except StartupError:  # invalid place of a virtual Pi; its check reports that
            return None

    def occupied(self, by_fishd: str) -> Result | None:
        """Return the result of a check if a fishd uses the hardware; None if no fishd does.

        by_fishd: what a running fishd does with the hardware, such as "owns the sensor"
        """
        if isinstance(self.daemon, Unreachable):
            return skipped(f"{self.daemon.why}; {self.suggest_remedy(self.daemon)}")
        if self.running:
            return skipped(f"fishd is running and {by_fishd}")
        if self.daemon:
            return skipped(
                f"the fishd at {self.daemon.endpoint} drives another robot, "
                f"{self.daemon.status.robot}; name this one's with --endpoint"
            )
        return skipped(f"{self.owner}; name it with --endpoint") if self.owner else None

    def suggest_remedy(self, daemon: Unreachable) -> str:
        """Return the remedy for a daemon that does not answer."""
        if daemon.forbidden:
            return f"{self.as_fishd}, or name another with --endpoint"
        return daemon.remedy or "stop what hangs there, or name the fishd with --endpoint"

    @property
    def as_fishd(self) -> str:
        """Command that runs these checks as the user of the service."""
        return self.as_user("fishd")

    def as_user(self, name: str) -> str:
        """Return the command that runs these checks as another user."""
        file = f" --config {self.file}" if self.file else ""
        return f"sudo -u {shlex.quote(name)} fishctl doctor{file}"

    @contextmanager
    def plugged_in(self) -> Iterator[None]:
        """Attach the bus to this process if the robot is a virtual Pi; raise `StartupError`."""
        with ExitStack() as stack:
            if self.is_virtual:
                assembly.plug_in_virtual_pi(self.config, stack)
            yield

    @property
    def drivers(self) -> tuple[ChosenDriver, ...]:
        """Drivers of the force sensor, the servo, and any other sensors."""
        return tuple(
            ChosenDriver(section, choice_of(section).plugins, name_of(section, settings), settings)
            for section, settings in self.config.driver_settings.sections().items()
        )


def sudo_unless(uid: int) -> str:
    """Return `sudo ` for a command of root or user `uid`; empty if this process is one of them."""
    return "" if os.geteuid() in (0, uid) else "sudo "
