"""Fish on its force sensor, between the pulses of a pigpiod and the inputs of an ADS1115.

The simulation is lazy: it advances to the current time when the chip converts, or on request.
"""

import math
import threading
from collections import deque
from collections.abc import Callable

from fishd.core.signals import Truth
from fishd.virtual.imperfections import Imperfections, SimulationSettings
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.plant.base import TrueWindow
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.registry import open_plant

STEP = 1e-4
"""Time step [s]. All durations are whole multiples of it, so that few different ones occur; the
fish caches its coefficients for each."""
_MAX_HISTORY = 1000
"""Number of windows in the history of the energy; there are about 1000 per second."""
_MAX_POWER_LAG_S = 0.02
"""Largest lag of the fish behind a request for its power [s]."""
_MAX_PIECE_STEPS = 200
"""Longest duration of one advance [steps], one servo frame."""
_CACHED_STEPS = 40
"""Longest duration whose coefficients are computed at the start [steps]; these occur often."""
_ROUNDING_S = 1e-7
"""Tolerance for rounding errors of the begin of a frame [s]."""
_INPUTS = ("A0-A1", "A0-A3", "A1-A3", "A2-A3", "A0", "A1", "A2", "A3")
"""Inputs by MUX code."""


class Tank:
    """Simulation that converts pulses to voltages; safe for use from several threads."""

    def __init__(
        self,
        settings: VirtualPiSettings,
        plant: PlantParameters,
        imperfections: SimulationSettings,
        tick: float,
        pulse: Callable[[float], float],
        start: float,
    ) -> None:
        """Create a fish at rest at `start` [s].

        tick: period to which the noise of `imperfections` refers [s]
        pulse: returns the servo pulse [µs] at a past or present time [s]; 0 without pulses
        """
        self._settings = settings
        self._pulse = pulse
        self._imperfections = Imperfections(imperfections, tick)
        self._weights = tuple(_weights(name, settings) for name in _INPUTS)
        self._fish = open_plant(plant, imperfections.motor)
        for steps in range(1, _CACHED_STEPS + 1):
            self._fish.advance(None, steps * STEP, 1)
        self._start = start
        self._now = _steps(start)
        self._conversion = (0.0, 0.0)
        self._steps = 0
        self._impulse = 0.0
        self._energy = self._total_energy = 0.0
        self._energy_history: deque[tuple[int, float]] = deque([(self._now, 0.0)], _MAX_HISTORY)
        """Steps, and the energy of the servo from the start until each [J]."""
        self._fin_peak = 0.0
        self._lock = threading.Lock()

    def volts(self, mux: int, begin: float, end: float) -> float:
        """Return the mean voltage at the inputs of `mux`, 0 to 7, from `begin` to `end` [s]."""
        weight_x, weight_y = self._weights[mux]
        with self._lock:
            self._advance(_steps(begin))
            first, last = self._now, max(_steps(end), _steps(begin) + 1)
            if last > first:  # otherwise a later state was requested meanwhile
                x, y = self._advance(last)
                span = (last - first) * STEP
                self._conversion = (x / span, y / span)
            fx, fy = self._imperfections.apply(
                *self._conversion, end - self._start, max(end - begin, STEP)
            )
        settings = self._settings
        vx = settings.sensitivity * (fx + settings.crosstalk * fy) + settings.zero_x
        vy = settings.sensitivity * (fy + settings.crosstalk * fx) + settings.zero_y
        return weight_x * vx + weight_y * vy

    def catch_up(self, time: float) -> None:
        """Advance to `time` [s], if that is later than the state."""
        with self._lock:
            self._advance(_steps(time))

    def power(self, begin: float, end: float) -> float:
        """Return the mean electrical power of the servo between two recent times [s] [W].

        While a conversion of the force sensor is running, the fish lags behind. The power is then
        that of an interval of the same length that ends at the state of the fish.
        """
        with self._lock:
            self._advance(_steps(end - _MAX_POWER_LAG_S))
            last = min(self._now, _steps(end))
            first = min(last - 1, last - (_steps(end) - _steps(begin)))
            energy = self._energy_until(last) - self._energy_until(first)
        return energy / ((last - first) * STEP)

    def _energy_until(self, step: int) -> float:
        """Return the energy of the servo up to a recent step [J]."""
        after = self._energy_history[-1]
        for before in reversed(self._energy_history):
            if before[0] <= step:
                length = after[0] - before[0]
                weight = (step - before[0]) / length if length else 0.0
                return before[1] + weight * (after[1] - before[1])
            after = before
        return after[1]

    def truth(self) -> Truth:
        """Return the true state at the end of the latest conversion."""
        with self._lock:
            state = self._fish.state
        return Truth(alpha=state.alpha, alpha_rate=state.alpha_rate, phi=state.phi)

    def instruction_angle(self, time: float) -> float | None:
        """Return the instruction angle [rad] of the pulse at a time [s]; None without pulses."""
        width = self._pulse(time)
        return (width - self._settings.servo_centre) / self._settings.servo_scale if width else None

    def take_window(self) -> TrueWindow:
        """Return the true motion and forces since the previous call, or since the start."""
        with self._lock:
            duration = self._steps * STEP
            thrust = self._impulse / duration if duration else 0.0
            power = self._energy / duration if duration else 0.0
            window = TrueWindow(duration, thrust, self._fin_peak, power)
            self._steps, self._impulse, self._energy = 0, 0.0, 0.0
            self._fin_peak = abs(self._fish.state.alpha)
        return window

    def _advance(self, until: int) -> tuple[float, float]:
        """Advance to a step, and return the impulses of F_x and F_y [N s]."""
        impulse_x = impulse_y = 0.0
        fish = self._fish
        while self._now < until:
            now = self._now
            instruction_angle = self._angle_at(now)
            end = self._next_change(instruction_angle, min(until, now + _MAX_PIECE_STEPS))
            rate = fish.state.alpha_rate
            window = fish.advance(instruction_angle, (end - now) * STEP, 1)
            duration = window.duration
            self._steps += end - now
            self._now = end
            self._energy += (energy := window.power * duration)
            self._total_energy += energy
            self._energy_history.append((end, self._total_energy))
            impulse_x += window.thrust * duration
            impulse_y += window.lateral_force * duration
            state = fish.state
            turned = rate * state.alpha_rate < 0.0  # otherwise the peak is at the end of the window
            peak = window.fin_peak if turned else abs(state.alpha)
            if peak > self._fin_peak:
                self._fin_peak = peak
        self._impulse += impulse_x
        return impulse_x, impulse_y

    def _angle_at(self, step: int) -> float | None:
        return self.instruction_angle(step * STEP + _ROUNDING_S)

    def _next_change(self, instruction_angle: float | None, until: int) -> int:
        """Return the step, at most `until`, up to which the pulses command this angle."""
        if self._angle_at(until) == instruction_angle:
            return until
        unchanged, changed = self._now, until
        while changed - unchanged > 1:
            middle = (unchanged + changed) // 2
            if self._angle_at(middle) == instruction_angle:
                unchanged = middle
            else:
                changed = middle
        return changed


def _steps(time: float) -> int:
    """Return the whole steps up to a time, rounded down, because later pulses are unknown."""
    return math.floor((time + _ROUNDING_S) / STEP)


def _weights(name: str, settings: VirtualPiSettings) -> tuple[float, float]:
    """Return the weights of the two channels' voltages at an input.

    The first pin of a channel carries its voltage; pins without a channel are grounded.
    """
    if name == settings.channel_x:
        return 1.0, 0.0
    if name == settings.channel_y:
        return 0.0, 1.0
    plus, _, minus = name.partition("-")

    def weight(channel: str) -> float:
        return float(channel[:2] == plus) - float(channel[:2] == minus)

    return weight(settings.channel_x), weight(settings.channel_y)
