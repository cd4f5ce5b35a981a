"""Argument and result of a check of `fishctl doctor`."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal, NamedTuple

from fishd.core.robots import RobotKind

START_VIRTUAL_PI = "fishctl virtual-pi run"
"""Remedy if no virtual Pi is running."""

Level = Literal["ok", "warning", "FAIL", "skipped"]


class Result(NamedTuple):
    """One line about what was checked, and the remedy where one is needed."""

    level: Level
    message: str
    remedy: str = ""


class Machine(ABC):
    """Computer that the robot is wired to."""

    root: Path = Path("/")
    """Folder that contains /sys, /proc, /dev and so on."""

    @property
    @abstractmethod
    def is_virtual(self) -> bool:
        """Whether the robot's hardware is a virtual Pi, beside this machine."""

    @property
    def model(self) -> str:
        """Model name of this machine, such as Raspberry Pi 5 Model B; empty if unknown."""
        return self.text("/proc/device-tree/model")

    @property
    def limitations(self) -> tuple[str, ...]:
        """Limitations that a running fishd of this robot reports; empty if none runs."""
        return ()

    def path(self, absolute: str) -> Path:
        """Return a path of this machine, below `root`."""
        return self.root / absolute.lstrip("/")

    def text(self, absolute: str) -> str:
        """Return the text of a small file without a final zero or newline; empty if unreadable."""
        try:
            return self.path(absolute).read_text(encoding="utf-8", errors="replace").rstrip("\0\n ")
        except OSError:
            return ""

    @abstractmethod
    def occupied(self, by_fishd: str) -> Result | None:
        """Return a result that says why a check must not use the hardware, or None.

        by_fishd: what a running fishd does, for the message, such as `owns the bus`
        """

    def plugged_in(self) -> AbstractContextManager[Any]:
        """Return a context in which I2C buses and pins are those of the robot, real or virtual.

        Raises `StartupError` if the robot needs a virtual Pi and none is running.
        """
        return nullcontext()


def on_this_machine(kind: type[RobotKind]) -> bool:
    """Return whether the hardware of a robot is wired to this machine."""
    return kind.has_hardware and not kind.is_virtual


class Check(NamedTuple):
    """Function of the machine, with its name; it returns None if there is nothing to check."""

    name: str
    function: Callable[[Any], Result | None]
    applies: Callable[[type[RobotKind]], bool] = lambda kind: True
    """Function that returns whether the check is for this robot."""


def ok(message: str) -> Result:
    """Return the result of a check that needs no action."""
    return Result("ok", message)


def warning(message: str, remedy: str) -> Result:
    """Return the result of a check of something that works but could be better."""
    return Result("warning", message, remedy)


def fail(message: str, remedy: str) -> Result:
    """Return the result of a check that failed: the robot cannot work."""
    return Result("FAIL", message, remedy)


def skipped(message: str) -> Result:
    """Return the result of a check that is undecided or was not tried."""
    return Result("skipped", message)


def user_name(uid: int) -> str:
    """Return the name of a user, or `#` and the number of a user without a name."""
    import pwd

    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"#{uid}"
