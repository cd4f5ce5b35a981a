"""`square`, `sine` and `triangle`: periodic waves of a given frequency and amplitude.

All keep their phase when the frequency changes. Sine and triangle start from the current angle.
"""

import math
from abc import abstractmethod
from typing import Annotated, ClassVar

from msgspec import Struct

from fishd.controllers.base import Amplitude, Controller, Limits, amplitude_of
from fishd.controllers.quantities import quantity
from fishd.core.errors import ParameterError
from fishd.core.schema import unit
from fishd.core.signals import Observation

START_SPREAD_S = 14.0
"""Time in which the fraction of a tick at which a square wave starts goes once from 0 to 1 [s]. The
swims of a measurement are 0.62 of it apart, the golden ratio, so that few are spread evenly."""
_ROUNDING = 1e-5
"""Relative rounding of a highest frequency with few digits, such as 7.14286 Hz for 0.07 s."""


def check_frequency(name: str, frequency: float, tick: float, *, highest: bool = True) -> None:
    """Refuse a frequency with fewer than two ticks per beat, which would alias.

    highest: whether exactly two ticks are permitted
    Raise `ParameterError`.
    """
    ratio = frequency * 2.0 * tick
    if ratio > 1.0 + _ROUNDING or (ratio > 1.0 - _ROUNDING and not highest):
        raise ParameterError(
            f"{name}: {frequency:g} Hz is too fast for ticks of {tick:g} s: "
            f"{'at most' if highest else 'less than'} {0.5 / tick:g} Hz is possible",
            (name,),
        )


class WaveformParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `square`, `sine` and `triangle`."""

    frequency: Annotated[
        float, unit("Hz", "Frequency of the waveform.", ge=0.001, le=10, step=0.05)
    ] = 1.8
    amplitude: Annotated[
        Amplitude,
        unit("rad", "Largest instruction angle; null: the robot's amplitude_limit."),
    ] = None


class Waveform(Controller[WaveformParameters]):
    """Base of waveforms: a phase that advances with time, and a shape that maps it to an angle.

    The phase runs from 0 to 1 over one period. Half periods that are not a whole number of ticks
    are dithered, so that the mean frequency is exact.
    """

    Parameters = WaveformParameters
    uses_lateral_force = False
    two_ticks_are_a_beat: ClassVar[bool] = True
    """Whether two ticks per beat are enough; otherwise both may be at neutral."""
    phase: float = quantity("1", "Phase of the waveform: 0 to 1 over one period.")

    def __init__(self, parameters: WaveformParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self.phase = 0.0
        self._first = True

    @classmethod
    def check(cls, parameters: WaveformParameters, limits: Limits) -> None:
        """Check the amplitude, and that the ticks are short enough; raise `ParameterError`."""
        super().check(parameters, limits)
        check_frequency(
            "frequency", parameters.frequency, limits.tick, highest=cls.two_ticks_are_a_beat
        )

    def update(self, observation: Observation) -> float:
        """Return the waveform's angle at this tick [rad]."""
        if self._first:
            self._first = False
        else:
            self.phase = (self.phase + self.parameters.frequency * observation.dt) % 1.0
        return self.amplitude * self.shape(self.phase)

    @property
    def amplitude(self) -> float:
        """Current amplitude [rad]."""
        return amplitude_of(self.parameters, self.limits)

    @abstractmethod
    def shape(self, phase: float) -> float:
        """Return the waveform, between −1 and 1; `phase` in [0, 1)."""


class Square(Waveform):
    """A square wave between plus and minus the amplitude: the waveform with the largest thrust."""

    def activate(self, observation: Observation) -> None:
        """Start on the side of the current angle, in each swim elsewhere in the dither."""
        fraction = observation.time / START_SPREAD_S % 1.0
        self.phase = fraction * self.parameters.frequency * self.limits.tick
        if observation.instruction_angle < 0:
            self.phase += 0.5

    def shape(self, phase: float) -> float:
        """Return +1 in the first half of the period, −1 in the second."""
        # A half period that is a whole number of ticks must not lose a tick to rounding.
        return 1.0 if (phase + 1e-9) % 1.0 < 0.5 else -1.0


class Smooth(Waveform):
    """A waveform without jumps: on a switch or a new amplitude it continues from the current angle.

    From an angle outside of the new waveform's range it returns at the waveform's top speed.
    """

    two_ticks_are_a_beat = False
    TOP_SPEED: float
    """Largest slope of the shape [1 / period]."""

    def __init__(self, parameters: WaveformParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._excess = 0.0

    def activate(self, observation: Observation) -> None:
        """Choose phase and excess so that the first angle is the current one."""
        instruction_angle = observation.instruction_angle
        self.phase = self.phase_of(max(-1.0, min(1.0, instruction_angle / self.amplitude)))
        self._excess = instruction_angle - self.amplitude * self.shape(self.phase)

    def retune(self, parameters: WaveformParameters) -> None:
        """Keep the phase; add the jump that a new amplitude would cause to the excess."""
        before = self.amplitude * self.shape(self.phase)
        super().retune(parameters)
        self._excess += before - self.amplitude * self.shape(self.phase)

    def update(self, observation: Observation) -> float:
        """Return the waveform's angle at this tick plus the remaining excess [rad]."""
        if not self._first:
            step = self.TOP_SPEED * self.amplitude * self.parameters.frequency * observation.dt
            self._excess -= max(-step, min(step, self._excess))
        return super().update(observation) + self._excess

    @abstractmethod
    def phase_of(self, level: float) -> float:
        """Return the phase on the rising flank at which the shape has `level`, in −1 … 1."""


class Sine(Smooth):
    """A sine wave."""

    TOP_SPEED = math.tau

    def shape(self, phase: float) -> float:
        """Return sin 2π·phase."""
        return math.sin(math.tau * phase)

    def phase_of(self, level: float) -> float:
        """Return the inverse of the rising flank."""
        return math.asin(level) / math.tau % 1.0


class Triangle(Smooth):
    """A triangle wave: constant speed between the two extremes."""

    TOP_SPEED = 4.0

    def shape(self, phase: float) -> float:
        """Return 0 at phase 0, 1 at a quarter, −1 at three quarters."""
        return 1.0 - 4.0 * abs((phase + 0.25) % 1.0 - 0.5)

    def phase_of(self, level: float) -> float:
        """Return the inverse of the rising flank."""
        return level / 4.0 % 1.0
