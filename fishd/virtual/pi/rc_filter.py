"""Resistor from the servo's pin to an input of the ADC, with a capacitor to ground.

The voltage is that of a first-order low-pass, exact between the edges of the pin.
"""

import math
import threading
from collections.abc import Callable, Iterable

from fishd.virtual.pi.pulse_train import SERVO_FRAME, Edge

SUPPLY_V = 3.3
"""Voltage of a pin at level 1 [V]."""
_MEMORY = 30
"""Time after which the voltage has forgotten its past, as a multiple of the time constant."""


class RcFilter:
    """Low-pass of the level of one pin; safe for use from several threads."""

    def __init__(
        self, edges: Callable[[float, float], Iterable[Edge]], time_constant: float
    ) -> None:
        """
        edges: returns the edges of the pin between two times, up to the present [s]
        time_constant: R·C [s]; 0: the voltage is that of the pin
        """
        self._edges = edges
        self._tau = max(time_constant, 1e-12)
        self._time = -math.inf
        self._level = 0
        self._volts = 0.0
        self._lock = threading.Lock()

    def mean(self, begin: float, end: float) -> float:
        """Return the mean voltage between two times; neither precedes those of earlier calls."""
        with self._lock:
            self._time = max(self._time, begin - _MEMORY * self._tau - SERVO_FRAME)
            self._advance(begin)
            return self._advance(end) / (end - begin)

    def _advance(self, until: float) -> float:
        """Advance to a time [s]; return the integral of the voltage [V s]."""
        area = 0.0
        for edge in (*self._edges(self._time, until), Edge(until, -1)):
            source = SUPPLY_V * self._level
            span = edge.time - self._time
            change = (self._volts - source) * -math.expm1(-span / self._tau)
            area += source * span + change * self._tau
            self._volts -= change
            self._time = edge.time
            if edge.level >= 0:
                self._level = edge.level
        return area
