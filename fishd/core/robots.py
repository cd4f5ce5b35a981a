"""The robots that fishd drives, by the name in `robot`, and the properties in which they differ.

Another package adds one with an entry point of group `fishd.robots`.
"""

from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

from msgspec import Struct

from fishd.core.errors import UnknownRobot

if TYPE_CHECKING:
    from fishd.core.plugins import Plugins


class NoSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a robot that adds no keys."""


class RobotKind:
    """A robot and its properties; by default those of a simulated fish on its rod."""

    Settings: ClassVar[type[Struct]] = NoSettings
    """Struct of section `robot_settings`; the robots of fishd have sections with their names."""
    is_tethered: ClassVar[bool] = True
    """Whether the fish hangs from a force sensor, so that its thrust can be measured."""
    is_real_time: ClassVar[bool] = True
    """Whether its time is that of the computer's clock, so that a tick can be late."""
    has_hardware: ClassVar[bool] = False
    """Whether it has drivers and calibrations, for parts that are real or emulated."""
    is_virtual: ClassVar[bool] = False
    """Whether that hardware is emulated: a virtual Pi."""
    extra: ClassVar[str] = ""
    """Extra of the package fishd that it needs, such as `pi`; empty for none."""
    packages: ClassVar[frozenset[tuple[str, str]]] = frozenset()
    """Extra and name of each package that it needs itself; drivers have their own."""
    hides_from_camera: ClassVar[str | None] = None
    """Reason why the simulated camera cannot show the fish; None if it can."""

    @classmethod
    def is_of_plant(cls) -> bool:
        """Return whether the fish is that of section `plant`, whose best square wave is known."""
        return cls.open is RobotKind.open

    @staticmethod
    def check(config: Any) -> None:
        """Refuse a configuration that is valid key by key, but not with this robot.

        Raise `fishd.core.schema.Problem`.
        """

    @staticmethod
    def slow_motion(config: Any) -> float:
        """Return the real time per time of the fish, if its time is not real time."""
        return 1.0

    @staticmethod
    def open(config: Any) -> Any:
        """Return the fish: an object with `robot()` and, for virtual time, `take_window()`.

        They return a `fishd.hardware.base.Robot` and a `fishd.virtual.plant.base.TrueWindow`. None
        stands for the simulated fish of section `plant`. Not called if the robot has drivers.
        """
        return None


class Simulated(RobotKind):
    """A simulated fish on its rod."""


class Pi(RobotKind):
    """The robot on this Raspberry Pi."""

    has_hardware = True
    extra = "pi"
    hides_from_camera = "this fishd drives a real fish"


class VirtualPi(Pi):
    """A simulated fish behind the drivers of the robot."""

    is_virtual = True
    hides_from_camera = "a virtual Pi does not publish the position of the tail"


_OWN: dict[str, type[RobotKind]] = {"simulated": Simulated, "pi": Pi, "virtual-pi": VirtualPi}


@cache
def registry() -> "Plugins[RobotKind]":
    """Return the registry of the robots, by the name in the configuration and in `Status.robot`."""
    from fishd.core.plugins import Plugins  # most programs need no other robots

    own = {name: f"fishd.core.robots:{kind.__name__}" for name, kind in _OWN.items()}
    built_in = {**own, "swimmer": "fishd.virtual.swimmer.kind:FreeSwimmer"}
    return Plugins("robot", "fishd.robots", RobotKind, "Settings", built_in, UnknownRobot)


def find_kind(name: str) -> type[RobotKind]:
    """Return the kind of a robot; that of a simulated fish for a name that is unknown here."""
    try:
        return _OWN.get(name) or registry().find(name)
    except UnknownRobot:
        return RobotKind
