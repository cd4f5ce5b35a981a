"""What is found at a point of a sweep: a thrust, or the speed of a fish that swims freely."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from msgspec import Struct
from msgspec.structs import fields


class Result(Struct, frozen=True):
    """What was found at a point; the measured columns of a sweep's table."""

    thrust: float | None = None
    """Mean over whole tail beats [N]; None where there is `trouble`."""
    error: float | None = None
    """Half of its 95 % interval [N]; None where it is not known."""
    beat_frequency: float = 0.0
    """Tail beats per second; 0 where the tail does not beat [Hz]."""
    relative_thrust: float | None = None
    """Thrust over that of the best square wave; of a simulated fish."""
    fin_amplitude: float | None = None
    """Largest fin angle of a half beat, mean [rad]; of a simulated fish."""
    power: float | None = None
    """Electrical power of the servo [W]; None where it is not known."""
    thrust_per_watt: float | None = None
    """[N/W]"""
    thrust_per_watt_error: float | None = None
    """Half of its 95 % interval [N/W]; of a simulated fish, as if its power had none."""
    seconds: float = 0.0
    """How long it swam and rested [s]."""
    trouble: str = ""
    """Why there is no thrust."""

    @property
    def value(self) -> float | None:
        """What curves are of."""
        return self.thrust


class SpeedResult(Struct, frozen=True):
    """The same of a fish that swims freely; powers are those of a fish one metre deep."""

    speed: float | None = None
    """Mean over whole tail beats, forwards [m/s]; None where there is `trouble`."""
    error: float | None = None
    """Half of its 95 % interval [m/s]; None where it is not known."""
    beat_frequency: float = 0.0
    """Tail beats per second; 0 where the tail does not beat [Hz]."""
    beats: int = 0
    """How many were judged."""
    settled: float | None = None
    """From when on they were [s]; None where the speed still changed in the end."""
    tail_width: float | None = None
    """How far the tip of the tail goes from side to side, over the length."""
    muscle_power: float | None = None
    """[W/m]"""
    cost_of_transport: float | None = None
    """[J/(kg m)]"""
    strouhal: float | None = None
    froude_efficiency: float | None = None
    seconds: float = 0.0
    """How long it swam [s]."""
    trouble: str = ""
    """Why there is no speed."""

    @property
    def value(self) -> float | None:
        """What curves are of."""
        return self.speed


Found = Result | SpeedResult


class Quantity(NamedTuple):
    """What a sweep is about."""

    name: str
    unit: str
    result: type[Result] | type[SpeedResult]

    @property
    def measured(self) -> tuple[str, ...]:
        """The measured columns of its table."""
        return tuple(field.name for field in fields(self.result))


def quantity_of(on: str, config: Mapping[str, Any], force_unit: str) -> Quantity:
    """What is found of this fish; config: as plain data."""
    if on == "simulation" and config.get("robot") == "swimmer":
        return Quantity("speed", "m/s", SpeedResult)
    return Quantity("thrust", force_unit, Result)
