"""What a check of `fishctl doctor` is given, and what it returns."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

from fishd.client import Fish
from fishd.config import Config
from fishd.errors import FishError, Refused
from fishd.protocol import Calibrations
from fishd.signals import Status, Tick

Level = Literal["ok", "warning", "FAIL", "skipped"]
PATIENCE = 1.0
"""How long a daemon may take to answer [s]."""


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
    def running(self) -> "Running | None":
        """What the daemon says; None where no daemon answers."""
        try:
            with Fish(self.endpoint, timeout=PATIENCE) as fish:
                return Running(
                    fish.status(), _latest_tick(fish), _calibrations(fish), fish.endpoint
                )
        except FishError:
            return None

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


class Running(NamedTuple):
    """What a running daemon says."""

    status: Status
    tick: Tick | None
    """The latest; None where telemetry is silent."""
    calibrations: Calibrations | None
    """None for a robot that has none."""
    endpoint: str


class Check(NamedTuple):
    """A function of the context; it returns None where there is nothing to check."""

    name: str
    function: Callable[[Context], Result | None]
    robots: tuple[str, ...] = ("simulated", "pi", "virtual-pi")
    """For which robots it is made."""


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
