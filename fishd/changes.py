"""What may change in the loop while it runs: prepared outside the tick, taken in at its start."""

from collections.abc import Callable
from typing import Any, NamedTuple

from msgspec import Struct

from fishd.controllers.base import Controller
from fishd.errors import Refused


class Switch(NamedTuple):
    """Put another controller in command."""

    name: str
    controller: Controller[Any]


class Retune(NamedTuple):
    """Give the running controller new, checked parameters."""

    controller: Controller[Any]
    """The one that the parameters were checked for."""
    parameters: Struct


class Stop(NamedTuple):
    """Fade to neutral and stay there."""


class ClearFault(NamedTuple):
    """Leave mode fault or estop."""


Change = Switch | Retune | Stop | ClearFault

Done = Callable[[Refused | None], None]
"""Called in the tick that takes the change in, or refuses it."""
