"""Simulated sensors: one with configured values, and stand-ins for those of a robot."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from fishd.core.schema import PRINTABLE, Reading, note, unit
from fishd.hardware.driver import SensorDriver, SensorSettings


class SimulatedSettings(SensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A sensor whose reading is value + amplitude · sin(2π · time / cycle)."""

    cycle: Annotated[Annotated[float, Meta(gt=0, le=1e6)], unit("s", "Period of its sine.")] = 60.0
    name: Annotated[str, note("Name of the reading.")] = "water_temperature"
    unit: Annotated[str, note("Unit of the reading.", max_length=20, pattern=PRINTABLE)] = "°C"
    description: Annotated[
        str, note("Description of the reading.", max_length=200, pattern=PRINTABLE)
    ] = "Simulated reading."
    value: Annotated[float, note("Mean of the reading.", ge=-1e9, le=1e9)] = 20.0
    amplitude: Annotated[float, note("Amplitude of its sine.", ge=0, le=1e9)] = 0.5
    low: Annotated[float | None, note("Value below which it is doubtful; null for none.")] = None
    high: Annotated[float | None, note("Value above which it is doubtful; null for none.")] = None


class Simulated(SensorDriver[SimulatedSettings]):
    """A simulated sensor with one reading, for every robot."""

    Settings = SimulatedSettings
    on_virtual_pi = True
    is_simulated = True

    @classmethod
    def declare(cls, settings: SimulatedSettings) -> Mapping[str, Reading]:
        """Return the one reading, as it is configured."""
        reading = Reading(settings.unit, settings.description, settings.low, settings.high)
        return {settings.name: reading}

    def sample(self) -> dict[str, float]:
        """Return the value at this time."""
        settings = self.settings
        turns = self.clock.monotonic() / settings.cycle
        wave = settings.amplitude * math.sin(2.0 * math.pi * turns)
        return {settings.name: settings.value + wave}


class StandIn(SensorDriver[Any]):
    """Stand-in of a simulated fish for a sensor of the robot: constants within the limits."""

    stands_for: ClassVar[type[SensorDriver[Any]]]

    @classmethod
    def of(cls, kind: type[SensorDriver[Any]]) -> type["StandIn"]:
        """Return the stand-in for a kind of sensor."""
        return type("StandIn", (cls,), {"stands_for": kind})

    @property
    def limitations(self) -> tuple[str, ...]:  # type: ignore[override]
        """Line that says that it is no true sensor."""
        return (f"{self.section} is simulated, as the fish is: its readings are constant",)

    def sample(self) -> dict[str, float]:
        """Return the middle of the limits of each reading."""
        readings = self.stands_for.declare(self.settings)
        return {name: _middle(reading) for name, reading in readings.items()}


def _middle(reading: Reading) -> float:
    """Return the middle of the limits, the only limit, or 0 without one."""
    limits = [limit for limit in (reading.low, reading.high) if limit is not None]
    return sum(limits) / max(1, len(limits))
