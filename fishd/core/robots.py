"""The robots that fishd drives, and their properties."""

from typing import NamedTuple


class RobotKind(NamedTuple):
    """Properties in which the robots differ."""

    is_tethered: bool = True
    """Whether the fish hangs from a force sensor, so that its thrust can be measured."""
    is_real_time: bool = True
    """Whether its time is that of the computer's clock, so that a tick can be late."""
    has_hardware: bool = False
    """Whether it has drivers and calibrations, for parts that are real or emulated."""
    is_virtual: bool = False
    """Whether that hardware is emulated: a virtual Pi."""
    extra: str = ""
    """Extra of the package fishd that it needs, such as `pi`; empty for none."""


ROBOTS = {
    "simulated": RobotKind(),
    "pi": RobotKind(has_hardware=True, extra="pi"),
    "virtual-pi": RobotKind(has_hardware=True, is_virtual=True, extra="pi"),
    "swimmer": RobotKind(is_tethered=False, is_real_time=False, extra="swimmer"),
}
"""Kind of each robot, by its name in the configuration and in `Status.robot`."""


def find_kind(name: str) -> RobotKind:
    """Return the kind of a robot; that of a simulated fish for a name that is unknown here."""
    return ROBOTS.get(name, RobotKind())
