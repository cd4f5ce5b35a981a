"""`excitation`: instruction angles for the identification of a fish."""

from typing import Annotated, Any

from msgspec import Struct

from fishd.controllers.base import Amplitude, Controller, Limits, amplitude_of
from fishd.controllers.waveform import check_frequency
from fishd.core.errors import ParameterError
from fishd.core.schema import unit
from fishd.core.signals import Observation


class ExcitationParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `excitation`."""

    lowest_frequency: Annotated[
        float, unit("Hz", "Frequency at which the sweep begins and ends.", gt=0, le=10, step=0.05)
    ] = 0.5
    highest_frequency: Annotated[
        float,
        unit(
            "Hz",
            "Highest frequency of the sweep, or that of a beat of two ticks if that is lower.",
            gt=0,
            le=10,
            step=0.05,
        ),
    ] = 3.0
    sweep_time: Annotated[
        float, unit("s", "Time of a sweep up and back down.", ge=1, le=3600, step=1)
    ] = 20.0
    amplitude: Annotated[
        Amplitude, unit("rad", "The larger instruction angle; null: the robot's amplitude_limit.")
    ] = None
    smaller: Annotated[
        float, unit("1", "The smaller instruction angle, as a fraction of the larger.", gt=0, le=1)
    ] = 0.4
    beats: Annotated[
        int, unit("1", "Number of beats of each of the two amplitudes in turn.", ge=1, le=1000)
    ] = 4


class Excitation(Controller[ExcitationParameters]):
    """Sweep a square wave's frequency with two amplitudes in turn, for identification.

    The sweep identifies fin and delay. A large step saturates the servo and a small one does not,
    so the two amplitudes separate its maximum speed from its lag, and backlash from both.
    """

    Parameters = ExcitationParameters
    uses_lateral_force = False

    def __init__(self, parameters: ExcitationParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._progress = 0.0
        """Progress of the sweep, 0 to 1 up and down again."""
        self._phase = 0.0
        """Phase since the start [beats]."""

    @classmethod
    def check(cls, parameters: Any, limits: Limits) -> None:
        """Refuse bounds in the wrong order or too high, and an amplitude beyond Φ."""
        super().check(parameters, limits)
        check_frequency("lowest_frequency", parameters.lowest_frequency, limits.tick)
        low, high = parameters.lowest_frequency, parameters.highest_frequency
        if high < low:
            raise ParameterError(
                f"highest_frequency: {high:g} Hz is below lowest_frequency, {low:g} Hz",
                ("highest_frequency",),
            )

    def activate(self, observation: Observation) -> None:
        """Start on the side of the current angle."""
        self._phase = 0.0 if observation.instruction_angle >= 0 else 0.5

    def update(self, observation: Observation) -> float:
        """Return plus or minus one of the two amplitudes [rad]."""
        p = self.parameters
        group, phase = int(self._phase // p.beats), self._phase % 1.0
        self._progress = (self._progress + observation.dt / p.sweep_time) % 1.0
        height = 1.0 - abs(1.0 - 2.0 * self._progress)
        low, high = p.lowest_frequency, min(p.highest_frequency, 0.5 / self.limits.tick)
        self._phase += (low + (high - low) * height) * observation.dt
        side = 1.0 if phase < 0.5 else -1.0
        return side * amplitude_of(p, self.limits) * (p.smaller if group % 2 else 1.0)
