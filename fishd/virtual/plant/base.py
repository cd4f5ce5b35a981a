"""Equations of a fish on its force sensor; docs/how-to/writing-a-plant.md adds a plant."""

import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

from msgspec import Struct

from fishd.core.schema import Problem, note, unit
from fishd.virtual.plant.parameters import PlantParameters

__all__ = [
    "REST",
    "Plant",
    "PlantParameters",
    "PlantState",
    "PlantWindow",
    "Problem",
    "TrueWindow",
    "Window",
    "note",
    "unit",
]

P = TypeVar("P", bound=PlantParameters)


class PlantState(NamedTuple):
    """State of the equations of the tethered fish."""

    phi: float = 0.0  # servo wheel angle, rad
    alpha: float = 0.0  # fin angle, rad
    alpha_rate: float = 0.0  # fin angular velocity, rad/s


REST = PlantState()


class Window(Protocol):
    """Forces and motion during one window, as a protocol; `PlantWindow` implements it."""

    @property
    def duration(self) -> float:
        """Length of the window [s]."""

    @property
    def thrust(self) -> float:
        """Mean of F_x over the window [N]."""

    @property
    def lateral_force(self) -> float:
        """Mean of F_y over the window [N]."""

    @property
    def sampled_thrust(self) -> float:
        """Mean of F_x at the midpoints of equal parts of the window [N]."""

    @property
    def sampled_lateral_force(self) -> float:
        """Mean of F_y at the midpoints of equal parts of the window [N]."""

    @property
    def fin_peak(self) -> float:
        """Largest |α| within the window [rad]."""

    @property
    def power(self) -> float:
        """Mean electrical power of the servo [W]; NaN for a fish without a motor."""


class PlantWindow(Struct, frozen=True):
    """Window with fixed values."""

    duration: float
    thrust: float
    lateral_force: float
    sampled_thrust: float
    sampled_lateral_force: float
    fin_peak: float
    power: float = math.nan


class TrueWindow(Struct, frozen=True, gc=False):
    """True values of a window, for the evaluation of a run."""

    duration: float
    """Length of the window [s]."""
    thrust: float
    """Mean F_x [N]."""
    fin_peak: float
    """Largest |α| [rad]."""
    power: float = math.nan
    """Mean electrical power of the servo [W]; NaN for a fish without a motor."""


class Plant(ABC, Generic[P]):
    """Tethered fish in still water, initially at rest; deterministic and without a clock."""

    Settings: ClassVar[type[Any]]
    """Struct of its keys in section `plant`: frozen, a subclass of `PlantParameters`."""

    state: PlantState
    """Current state."""

    def __init__(self, parameters: P) -> None:
        """parameters: constants of this fish"""
        self.parameters = parameters

    @classmethod
    def check(cls, parameters: P) -> None:
        """Refuse parameters that are valid on their own but not together.

        Raises `Problem((key,), message)`.
        """

    @abstractmethod
    def advance(self, instruction_angle: float | None, duration: float, samples: int) -> Window:
        """Hold the instruction angle (rad) for `duration` s, and return the window.

        None means no pulses: the wheel then keeps its angle. The sampled means are those of
        `samples` equally spaced instants, at which an ADC would be read.
        """
