"""A sensor of the loop whose samples a test sets."""

from collections.abc import Callable
from dataclasses import dataclass, field

from fishd.core.schema import Reading

WATER = Reading("°C", "Temperature of the water.", 0.0, 50.0)


@dataclass
class ScriptedSensor:
    name: str = "water"
    declared: dict[str, Reading] = field(default_factory=lambda: {"water_temperature": WATER})
    required: bool = False
    stale_after: float = 0.525
    latest: Callable[[], dict[str, tuple[float, float]]] = dict
    doubts: dict[str, str] = field(default_factory=dict)
    trouble: str | None = None

    def read(self) -> dict[str, tuple[float, float]]:
        return self.latest()

    def give(self, time: float, value: float) -> None:
        """Let its reading have a sample of this time."""
        (name,) = self.declared
        self.latest = lambda: {name: (time, value)}
