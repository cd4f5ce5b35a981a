"""Finds the plant that `plant.model` names: fishd's own, or that of another package."""

import math
from typing import Any

from fishd.core import text
from fishd.core.errors import FishLost, StartupError, UnknownPlant
from fishd.core.foreign_code import call_foreign
from fishd.core.plugins import Plugins
from fishd.virtual.plant.base import Plant, Window
from fishd.virtual.plant.parameters import TETHERED, MotorSettings, PlantParameters

PLANTS: Plugins[Plant[Any]] = Plugins(
    "plant",
    "fishd.plants",
    Plant,
    "Settings",
    {TETHERED: "fishd.virtual.plant.tethered:TetheredFish"},
    UnknownPlant,
    of=PlantParameters,
)


def open_plant(parameters: PlantParameters, motor: MotorSettings | None = None) -> Plant[Any]:
    """A fish with these parameters, at rest.

    motor: of the servo, where its power is of interest; plants of other packages have none
    Raises `UnknownPlant`, and `StartupError` where that of another package cannot begin.
    """
    kind: Any = PLANTS.find(parameters.model)
    if parameters.model == TETHERED:
        fish: Plant[Any] = kind(parameters, motor=motor)
        return fish
    return _Contained(kind, parameters)


class _Contained(Plant[PlantParameters]):
    """A plant of another package: whatever it raises or returns, fishd says so in one line."""

    Settings = PlantParameters

    def __init__(self, kind: type[Plant[Any]], parameters: PlantParameters) -> None:
        super().__init__(parameters)
        try:
            self._plant = call_foreign(kind, parameters)
            self.state = self._plant.state
        except Exception as error:
            what = f"plant '{parameters.model}' cannot begin: {text.describe_error(error)}"
            raise StartupError(what) from error

    def advance(self, instruction_angle: float | None, duration: float, samples: int) -> Window:
        """As `Plant.advance`; raises `FishLost`, then and ever after."""
        try:
            window = call_foreign(self._plant.advance, instruction_angle, duration, samples)
            self.state = self._plant.state
            numbers = (
                *(window.thrust, window.lateral_force, window.fin_peak),
                *(window.sampled_thrust, window.sampled_lateral_force, *self.state),
            )
            if not all(map(math.isfinite, numbers)):
                raise ArithmeticError("its forces or its state are not finite")
        except Exception as error:
            what = f"plant '{self.parameters.model}' cannot go on: {text.describe_error(error)}"
            raise FishLost(what) from error
        return window
