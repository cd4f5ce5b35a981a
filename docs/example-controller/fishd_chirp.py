"""`chirp`: a square wave whose frequency sweeps slowly up and down between two bounds."""

from typing import Annotated, Any

from msgspec import Struct

from fishd.controllers import (
    Amplitude,
    Controller,
    Limits,
    Observation,
    ParameterError,
    amplitude_of,
    quantity,
    unit,
)


class ChirpParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `chirp`."""

    lowest: Annotated[float, unit("Hz", "Frequency at which the sweep begins.", gt=0, le=10)] = 0.5
    highest: Annotated[float, unit("Hz", "Frequency at which it turns back.", gt=0, le=10)] = 3.0
    sweep_time: Annotated[float, unit("s", "Time from lowest to highest.", ge=1, le=3600)] = 60.0
    amplitude: Annotated[
        Amplitude,
        unit("rad", "Instruction angle on either side; null: the robot's amplitude_limit."),
    ] = None


class Chirp(Controller[ChirpParameters]):
    """Sweep a square wave's frequency up and down: thrust against frequency in one run."""

    Parameters = ChirpParameters
    frequency: float = quantity("Hz", "Present frequency of the sweep.")

    def __init__(self, parameters: ChirpParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._progress = 0.0  # 0 to 1 on the way up, 1 to 2 on the way down
        self._phase = 0.0  # 0 to 1 over one period of the square wave

    @classmethod
    def check(cls, parameters: Any, limits: Limits) -> None:
        """Refuse bounds in the wrong order, and an amplitude beyond Φ."""
        super().check(parameters, limits)
        if parameters.highest <= parameters.lowest:
            raise ParameterError(
                f"highest: {parameters.highest:g} Hz must be above lowest, {parameters.lowest:g} Hz"
            )

    def activate(self, observation: Observation) -> None:
        """Start on the side of the present angle."""
        self._phase = 0.0 if observation.instruction_angle >= 0 else 0.5

    def update(self, observation: Observation) -> float:
        """Return plus or minus the amplitude [rad]."""
        p = self.parameters
        self._progress = (self._progress + observation.dt / p.sweep_time) % 2.0
        height = 1.0 - abs(1.0 - self._progress)
        self.frequency = p.lowest + (p.highest - p.lowest) * height
        self._phase = (self._phase + self.frequency * observation.dt) % 1.0
        side = 1.0 if self._phase < 0.5 else -1.0
        return side * amplitude_of(p, self.limits)
