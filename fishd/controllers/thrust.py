"""`thrust`: hold a wanted mean thrust, by the amplitude, at the frequency of swinging control."""

import math
from typing import Annotated, ClassVar

from msgspec import Struct

from fishd.controllers.base import Amplitude, Controller, Likeness, Limits, amplitude_of
from fishd.controllers.quantities import quantity
from fishd.controllers.reversal import Reversal
from fishd.controllers.thrust_gauge import ThrustGauge
from fishd.core.errors import ParameterError
from fishd.core.schema import unit
from fishd.core.signals import Observation

LONGEST_TICK = 0.15
"""With longer ones a half beat has two or three, and the ripple of F_x cannot be told [s]."""
LEAST = 0.05
"""The smallest amplitude is this share of the largest one."""
BEGIN = 0.4
"""The first amplitude, as a share of the largest one."""
FAST, SLOW = 0.3, 0.03
"""By which share of what is missing (as a logarithm) the amplitude changes after a half beat: at
first, and once it has settled. A thrust that goes with the square of the amplitude needs half of
it, and the beat that it is taken over is by a half beat older than the amplitude."""
SETTLES = 6
"""Half beats until the share becomes smaller, as one over their number."""
UPSET = 0.15
"""With so much missing on average over the latest beats it has to settle anew: another fish."""
MOST = 0.7
"""No more than this is believed to be missing, as a logarithm: a beat may be disturbed."""
MISSES = 0.005
"""A target that is missed by this share at an end of the range cannot be reached."""


class ThrustParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `thrust`."""

    target: Annotated[float, unit("N", "Mean thrust to hold.", gt=0, le=10, usual=1)]
    C: Annotated[
        float,
        unit("1", "Reverse when the fin's speed falls to C times its last maximum.", ge=0, le=1),
    ] = 0.6
    amplitude: Annotated[
        Amplitude,
        unit("rad", "Largest instruction angle on either side; null: the robot's amplitude_limit."),
    ] = None
    longest_half_period: Annotated[
        float,
        unit(
            "s",
            "Reverse after this time even if the fin shows no sign of slowing down.",
            gt=0,
            le=10,
            usual=5,
        ),
    ] = 1.0


class Thrust(Controller[ThrustParameters]):
    """Hold a wanted mean thrust: swim as swing does, at the amplitude that gives it.

    The thrust is told from the fin velocity, which does not drift: see `ThrustGauge`. A target
    beyond what the amplitude can do is held at the nearest amplitude.
    """

    Parameters = ThrustParameters
    swims_like: ClassVar[Likeness | None] = Likeness("swing", frozenset({"target"}))
    amplitude: float = quantity("rad", "Amplitude in use.")
    held_thrust: float | None = quantity("N", "Thrust of the latest beats, as it is regulated by.")
    held_error: float | None = quantity("N", "Half of the 95 % interval of `held_thrust`.")
    saturated: float = quantity(
        "1", "1: the target is more than the largest amplitude gives; -1: less than the smallest."
    )

    def __init__(self, parameters: ThrustParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._reversal = Reversal(limits)
        self._gauge = ThrustGauge(limits.thrust_coefficient)
        self._missing = 0.0
        self._settled = 0
        """Half beats since it was far from the target."""
        self._largest = amplitude_of(parameters, limits)
        self.amplitude = BEGIN * self._largest
        self.held_thrust = self.held_error = None
        self.saturated = 0.0

    @classmethod
    def check(cls, parameters: ThrustParameters, limits: Limits) -> None:
        """As for any controller; and F_x must be the thrust. Raises `ParameterError`."""
        super().check(parameters, limits)
        if not limits.tethered:
            raise ParameterError(
                "it holds a thrust by F_x, which is the thrust of a tethered fish only; swing and "
                "the waves swim with an amplitude that is set"
            )
        if limits.tick > LONGEST_TICK:
            raise ParameterError(
                f"it needs ticks of {LONGEST_TICK:g} s at most, not {limits.tick:g} s, to see the "
                "ripple of F_x"
            )

    def activate(self, observation: Observation) -> None:
        """Push on towards the side of the present angle; from rest, towards plus."""
        self._reversal.begin(observation.instruction_angle)

    def retune(self, parameters: ThrustParameters) -> None:
        """Take new parameters, and settle anew."""
        super().retune(parameters)
        self._largest = amplitude_of(parameters, self.limits)
        self.amplitude = self._within(self.amplitude)
        self._settled = 0

    def update(self, observation: Observation) -> float:
        """Plus or minus the amplitude [rad]."""
        parameters = self.parameters
        self._reversal.update(observation, parameters.C, 0.0, parameters.longest_half_period)
        if self._gauge.update(observation):
            self._regulate()
        return self._reversal.direction * self.amplitude

    def _regulate(self) -> None:
        """After a half beat: nearer to the target."""
        gauge, target = self._gauge, self.parameters.target
        self.held_thrust, self.held_error = gauge.thrust, gauge.error
        if gauge.latest is None:
            return
        missing = max(-MOST, min(MOST, math.log(target / max(gauge.latest, 1e-3 * target))))
        self._missing += 0.5 * (missing - self._missing)
        if abs(self._missing) > UPSET:
            self._settled = 0
        self._settled += 1
        share = max(SLOW, FAST / max(1.0, self._settled - SETTLES))
        wanted = self.amplitude * math.exp(share * missing)
        self.amplitude = self._within(wanted)
        believed = gauge.thrust or gauge.latest
        above = self.amplitude < wanted and believed < (1.0 - MISSES) * target
        below = self.amplitude > wanted and believed > (1.0 + MISSES) * target
        self.saturated = float(above - below)

    def _within(self, amplitude: float) -> float:
        largest = self._largest
        return max(LEAST * largest, min(largest, amplitude))
