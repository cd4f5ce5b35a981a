"""What a check of `fishctl doctor` is given, and what it returns."""

import os
import pwd
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

from fishd import robots
from fishd.cli.checks.daemon import Running, Unreachable, ask
from fishd.config import Config
from fishd.errors import StartupError
from fishd.hardware import ownership

INSTALL = f"{sys.executable} -m pip install 'fishd[pi]'"
"""Mends a missing driver."""

Level = Literal["ok", "warning", "FAIL", "skipped"]


class Result(NamedTuple):
    """One line about one thing, and how to mend it where that is needed."""

    level: Level
    message: str
    mend: str = ""


@dataclass
class Context:
    """What the checks look at: the configuration, this machine and a daemon, if one runs."""

    config: Config
    file: Path | None = None
    """The configuration file; None for the defaults."""
    endpoint: str | None = None
    root: Path = field(default_factory=lambda: Path("/"))
    """Where /sys, /proc, /dev and so on are looked for."""

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
            return ownership.owner(robots.parts_of(self.config))
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

    def path(self, absolute: str) -> Path:
        """A path of this machine, below `root`."""
        return self.root / absolute.lstrip("/")

    def text(self, absolute: str) -> str:
        """A small file's text without the zero or newline at its end; empty if unreadable."""
        try:
            return self.path(absolute).read_text(encoding="utf-8", errors="replace").rstrip("\0\n ")
        except OSError:
            return ""

    @property
    def model(self) -> str:
        """What this machine calls itself, such as Raspberry Pi 5 Model B; empty if unknown."""
        return self.text("/proc/device-tree/model")


class Check(NamedTuple):
    """A function of the context; it returns None where there is nothing to check."""

    name: str
    function: Callable[[Context], Result | None]
    robots: tuple[str, ...] = ("simulated", "pi", "virtual-pi")
    """For which robots it is made."""


def sudo_unless(uid: int) -> str:
    """`sudo ` for a command that only this user, or root, may give; empty where that is us."""
    return "" if os.geteuid() in (0, uid) else "sudo "


def name_of(uid: int) -> str:
    """The name of a user, or its number where it has none."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"#{uid}"


def ok(message: str) -> Result:
    """Nothing to do."""
    return Result("ok", message)


def warning(message: str, mend: str) -> Result:
    """It works, but could be better."""
    return Result("warning", message, mend)


def fail(message: str, mend: str) -> Result:
    """It cannot work."""
    return Result("FAIL", message, mend)


def skipped(message: str) -> Result:
    """It cannot be told, or was not tried."""
    return Result("skipped", message)
