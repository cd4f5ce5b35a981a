"""`swing`: reverse when the fin slows down. The paper's model-free control (Fu et al.)."""

from typing import Annotated

from msgspec import Struct

from fishd.controllers.base import Amplitude, Controller, Limits, amplitude_of
from fishd.controllers.quantities import quantity
from fishd.core.schema import unit
from fishd.core.signals import Observation

REFRACTORY = 0.05
"""Share of the longest half period in which noise, at small ticks, cannot cause a reversal."""


class SwingParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `swing`."""

    C: Annotated[
        float,
        unit("1", "Reverse when the fin's speed falls to C times its last maximum.", ge=0, le=1),
    ] = 0.6
    amplitude: Annotated[
        Amplitude,
        unit("rad", "Instruction angle on either side; null: the robot's amplitude_limit."),
    ] = None
    longest_half_period: Annotated[
        float,
        unit(
            "s",
            "Reverse after this time even if the fin shows no sign of slowing down.",
            gt=0,
            le=10,
        ),
    ] = 1.0


class Swing(Controller[SwingParameters]):
    """Reverse the tail when the fin slows to a fraction C of its last top speed.

    It knows nothing of the fish: only the shape of the fin velocity counts, so any positive scale
    cancels. The square wave that results is close to the best there is.
    """

    Parameters = SwingParameters
    top_speed: float = quantity(
        "1",
        "The fin's highest speed in a half beat: of this one, once past it; before, of the last.",
    )
    reversal_speed: float = quantity("1", "C times `top_speed`: the tail reverses when so slow.")
    since_reversal: float = quantity("s", "Time since the last reversal.")

    def __init__(self, parameters: SwingParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._direction = 1.0
        self._top_speed = 0.0  # since the last reversal
        self.top_speed = 0.0
        self.reversal_speed = 0.0
        self.since_reversal = 0.0

    def activate(self, observation: Observation) -> None:
        """Push on towards the side of the present angle; from rest, towards plus."""
        self._direction = 1.0 if observation.instruction_angle >= 0 else -1.0

    def update(self, observation: Observation) -> float:
        """Plus or minus the amplitude [rad]."""
        self.since_reversal += observation.dt
        speed = self._direction * observation.fin_velocity
        parameters = self.parameters
        slowed = self._top_speed > 0.0 and speed <= parameters.C * self._top_speed
        self._top_speed = max(self._top_speed, speed)
        settled = self.since_reversal > REFRACTORY * parameters.longest_half_period
        # Half a tick early is nearer to the longest half period than half a tick late.
        overdue = self.since_reversal + 0.5 * self.limits.tick > parameters.longest_half_period
        reverses = (slowed and settled) or overdue
        if self._top_speed > 0.0 and (reverses or speed < self._top_speed):
            self.top_speed = self._top_speed
        if reverses:
            self._direction = -self._direction
            self._top_speed = 0.0
            self.since_reversal = 0.0
        self.reversal_speed = parameters.C * self.top_speed
        return self._direction * amplitude_of(parameters, self.limits)
