"""`thrust`: control of the mean thrust by the amplitude, at the frequency of `swing`."""

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

MAX_TICK_S = 0.15
"""Longest tick: with longer ones the ripple of a half beat cannot be measured [s]."""
MIN_AMPLITUDE_FRACTION = 0.05
"""Smallest amplitude, as a fraction of the largest one."""
START_AMPLITUDE_FRACTION = 0.4
"""First amplitude, as a fraction of the largest one."""
FAST_RATE, SLOW_RATE = 0.3, 0.03
"""Gains of the controller, at first and once it has settled: change of the logarithm of the
amplitude per half beat over the logarithmic error of the thrust. Thrust is proportional to the
square of the amplitude, and its measurement lags by half a beat."""
SETTLING_HALF_BEATS = 6
"""Number of half beats after which the gain begins to decrease, inversely to their number."""
RESETTLING_ERROR = 0.15
"""Mean error over the latest beats that restarts the settling, as for another fish."""
MAX_ERROR = 0.7
"""Limit of the logarithmic error, since a beat may be disturbed."""
SATURATION_TOLERANCE = 0.005
"""Relative error at an end of the range above which the target counts as unreachable."""


class ThrustParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `thrust`."""

    target: Annotated[float, unit("N", "Mean thrust to hold.", gt=0, le=10, usual=1, step=0.001)]
    C: Annotated[
        float,
        unit(
            "1",
            "Reverse when the fin's speed falls to C times its last maximum.",
            ge=0,
            le=1,
            step=0.05,
        ),
    ] = 0.6
    amplitude: Annotated[
        Amplitude,
        unit(
            "rad",
            "Largest instruction angle on either side; null: the robot's amplitude_limit.",
            step=0.01,
        ),
    ] = None
    longest_half_period: Annotated[
        float,
        unit(
            "s", "Reverse after this time even if the fin does not slow down.", gt=0, le=10, usual=5
        ),
    ] = 1.0


class Thrust(Controller[ThrustParameters]):
    """Hold a target mean thrust: swim like swing, at the amplitude that gives it.

    The thrust is measured from the fin velocity, which does not drift: see `ThrustGauge`. For an
    unreachable target, the nearest amplitude is used.
    """

    Parameters = ThrustParameters
    same_wave_as: ClassVar[Likeness | None] = Likeness("swing", frozenset({"target"}))
    amplitude: float = quantity("rad", "Current amplitude.")
    held_thrust: float | None = quantity(
        "N", "Thrust of the latest beats, as used by the controller."
    )
    held_thrust_ci95: float | None = quantity(
        "N", "Half-width of the 95 % confidence interval of `held_thrust`."
    )
    saturated: float = quantity(
        "1", "1: the largest amplitude gives less than the target; -1: the smallest gives more."
    )

    def __init__(self, parameters: ThrustParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._reversal = Reversal(limits)
        self._gauge = ThrustGauge(limits.thrust_coefficient)
        self._missing = 0.0
        self._settled = 0
        """Number of half beats since it was far from the target."""
        self._largest = amplitude_of(parameters, limits)
        self.amplitude = START_AMPLITUDE_FRACTION * self._largest
        self.held_thrust = self.held_thrust_ci95 = None
        self.saturated = 0.0

    @classmethod
    def check(cls, parameters: ThrustParameters, limits: Limits) -> None:
        """Check the amplitude, and that F_x is the thrust; raise `ParameterError`."""
        super().check(parameters, limits)
        if not limits.tethered:
            raise ParameterError(
                "it controls F_x, which is the thrust of a tethered fish only; use swing or a "
                "waveform, with an amplitude"
            )
        if limits.tick > MAX_TICK_S:
            raise ParameterError(
                f"it needs ticks of {MAX_TICK_S:g} s at most, not {limits.tick:g} s, to measure "
                "the ripple of F_x"
            )

    def activate(self, observation: Observation) -> None:
        """Push on towards the side of the present angle; from rest, towards plus."""
        self._reversal.begin(observation.instruction_angle)

    def retune(self, parameters: ThrustParameters) -> None:
        """Apply new parameters, and restart the settling."""
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
        """Move the amplitude towards the target after a half beat."""
        gauge, target = self._gauge, self.parameters.target
        self.held_thrust, self.held_thrust_ci95 = gauge.thrust, gauge.ci95
        if gauge.latest is None:
            return
        error = max(-MAX_ERROR, min(MAX_ERROR, math.log(target / max(gauge.latest, 1e-3 * target))))
        self._missing += 0.5 * (error - self._missing)
        if abs(self._missing) > RESETTLING_ERROR:
            self._settled = 0
        self._settled += 1
        share = max(SLOW_RATE, FAST_RATE / max(1.0, self._settled - SETTLING_HALF_BEATS))
        unlimited = self.amplitude * math.exp(share * error)
        self.amplitude = self._within(unlimited)
        thrust = gauge.thrust or gauge.latest
        above = self.amplitude < unlimited and thrust < (1.0 - SATURATION_TOLERANCE) * target
        below = self.amplitude > unlimited and thrust > (1.0 + SATURATION_TOLERANCE) * target
        self.saturated = float(above - below)

    def _within(self, amplitude: float) -> float:
        largest = self._largest
        return max(MIN_AMPLITUDE_FRACTION * largest, min(largest, amplitude))
