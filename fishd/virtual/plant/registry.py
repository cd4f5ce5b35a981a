"""Registry of plants by `plant.model`: the built-in one, and those of other packages."""

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
    """Return a fish with these parameters, at rest.

    motor: motor of the servo, if its power is needed; plants of other packages have none
    Raises `UnknownPlant`, and `StartupError` where a plant of another package cannot start.
    """
    kind: Any = PLANTS.find(parameters.model)
    if parameters.model == TETHERED:
        fish: Plant[Any] = kind(parameters, motor=motor)
        return fish
    return _ForeignPlant(kind, parameters)


class _ForeignPlant(Plant[PlantParameters]):
    """Plant of another package, whose exceptions become errors of fishd with one line."""

    Settings = PlantParameters

    def __init__(self, kind: type[Plant[Any]], parameters: PlantParameters) -> None:
        super().__init__(parameters)
        try:
            self._plant = call_foreign(kind, parameters)
            self.state = self._plant.state
        except Exception as error:
            message = f"plant '{parameters.model}' cannot begin: {text.describe_error(error)}"
            raise StartupError(message) from error

    def advance(self, instruction_angle: float | None, duration: float, samples: int) -> Window:
        """Advance the plant; raises `FishLost` when it fails."""
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
            message = f"plant '{self.parameters.model}' cannot go on: {text.describe_error(error)}"
            raise FishLost(message) from error
        return window
