"""Result at a point of a sweep: a thrust, or the speed of a freely swimming fish."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from msgspec import Struct
from msgspec.structs import fields

from fishd.core.robots import ROBOTS


class Result(Struct, frozen=True):
    """Thrust at a point; the fields are the measured columns of a sweep's table."""

    thrust: float | None = None
    """Mean thrust over whole tail beats [N]; None if there is `trouble`."""
    error: float | None = None
    """Half-width of the 95 % confidence interval of `thrust` [N]; None if unknown."""
    beat_frequency: float = 0.0
    """Tail beats per second; 0 if the tail does not beat [Hz]."""
    relative_thrust: float | None = None
    """Thrust divided by the thrust of the best square wave; of a simulated fish."""
    fin_amplitude: float | None = None
    """Mean over half beats of the largest fin angle [rad]; of a simulated fish."""
    power: float | None = None
    """Electrical power of the servo [W]; None if unknown."""
    thrust_per_watt: float | None = None
    """Thrust divided by `power` [N/W]."""
    thrust_per_watt_error: float | None = None
    """Half-width of its 95 % confidence interval [N/W]; simulated power counts as exact."""
    seconds: float = 0.0
    """Duration of swimming and resting [s]."""
    trouble: str = ""
    """Reason for a missing thrust; empty if there is a thrust."""

    @property
    def value(self) -> float | None:
        """Quantity that curves show."""
        return self.thrust


class SpeedResult(Struct, frozen=True):
    """Speed at a point of a freely swimming fish; powers are those of a fish one metre deep."""

    speed: float | None = None
    """Mean forward speed over whole tail beats [m/s]; None if there is `trouble`."""
    error: float | None = None
    """Half-width of the 95 % confidence interval of `speed` [m/s]; None if unknown."""
    beat_frequency: float = 0.0
    """Tail beats per second; 0 if the tail does not beat [Hz]."""
    beats: int = 0
    """Number of measured beats."""
    settled: float | None = None
    """Time at which the measured beats begin [s]; None if the speed still changed at the end."""
    tail_width: float | None = None
    """Distance of the tail tip from side to side, in body lengths."""
    muscle_power: float | None = None
    """Power of the muscles [W/m]."""
    cost_of_transport: float | None = None
    """Energy per mass and distance [J/(kg m)]."""
    strouhal: float | None = None
    froude_efficiency: float | None = None
    seconds: float = 0.0
    """Duration of the swim [s]."""
    trouble: str = ""
    """Reason for a missing speed; empty if there is a speed."""

    @property
    def value(self) -> float | None:
        """Quantity that curves show."""
        return self.speed


PointResult = Result | SpeedResult


class Quantity(NamedTuple):
    """Quantity that a sweep measures."""

    name: str
    unit: str
    result: type[Result] | type[SpeedResult]

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the measured columns of the table."""
        return tuple(field.name for field in fields(self.result))


def select_quantity(on: str, config: Mapping[str, Any], force_unit: str) -> Quantity:
    """Return the quantity that a sweep of this fish measures; config: as plain data."""
    if on == "simulation" and not ROBOTS[config["robot"]].is_tethered:
        return Quantity("speed", "m/s", SpeedResult)
    return Quantity("thrust", force_unit, Result)
