"""`hold`: one constant instruction angle."""

import math
from typing import Annotated

from msgspec import Struct

from fishd.controllers.base import Controller, Limits
from fishd.core.errors import ParameterError
from fishd.core.schema import unit
from fishd.core.signals import Observation


class HoldParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `hold`."""

    angle: Annotated[
        float,
        unit("rad", "The instruction angle; 0 is neutral.", ge=-math.pi, le=math.pi, step=0.01),
    ] = 0.0


class Hold(Controller[HoldParameters]):
    """Hold one instruction angle, by default neutral."""

    Parameters = HoldParameters
    uses_lateral_force = False

    @classmethod
    def check(cls, parameters: HoldParameters, limits: Limits) -> None:
        """Refuse an angle beyond Φ."""
        if abs(parameters.angle) > limits.amplitude:
            raise ParameterError(
                f"angle: {parameters.angle:g} rad is beyond the robot's amplitude_limit, "
                f"±{limits.amplitude:g} rad"
            )

    def update(self, observation: Observation) -> float:
        """Return the constant angle [rad]."""
        return self.parameters.angle
