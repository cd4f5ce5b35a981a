"""The fish on its force sensor, between the pulses of a pigpiod and the inputs of an ADS1115.

It swims lazily: it catches up with the time when the chip converts, or when someone asks.
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
"""Time moves in whole multiples of this [s], so that few different lengths of time occur: the fish
remembers what it computed for each."""
_REMEMBERED = 1000  # windows; the force sensor makes some 1000 in a second
_LATE = 0.02  # by how much the fish may lag behind who asks for its power, s
_PIECE = 200  # longest stretch swum at once, in steps: one servo frame
_WARMED_UP = 40  # stretches up to this many steps are met all the time
_ROUNDING = 1e-7  # a frame that begins with a step has begun by then [s]
_INPUTS = ("A0-A1", "A0-A3", "A1-A3", "A2-A3", "A0", "A1", "A2", "A3")  # by MUX code


class Tank:
    """Turns pulses into voltages; safe for use from several threads."""

    def __init__(
        self,
        settings: VirtualPiSettings,
        plant: PlantParameters,
        imperfections: SimulationSettings,
        tick: float,
        pulse: Callable[[float], float],
        start: float,
    ) -> None:
        """The fish is at rest at `start` [s].

        tick: period that the noise of `imperfections` refers to [s]
        pulse: the servo pulse at a time [s], past or present [µs]; 0 for none
        """
        self._settings = settings
        self._pulse = pulse
        self._imperfections = Imperfections(imperfections, tick)
        self._weights = tuple(_weights(name, settings) for name in _INPUTS)
        self._fish = open_plant(plant, imperfections.motor)
        for steps in range(1, _WARMED_UP + 1):
            self._fish.advance(None, steps * STEP, 1)
        self._start = start
        self._now = _steps(start)
        self._conversion = (0.0, 0.0)
        self._steps = 0
        self._impulse = 0.0
        self._energy = self._spent = 0.0
        self._past: deque[tuple[int, float]] = deque([(self._now, 0.0)], _REMEMBERED)
        """Steps, and what the servo had taken from the start until then [J]."""
        self._fin_peak = 0.0
        self._lock = threading.Lock()

    def volts(self, mux: int, begin: float, end: float) -> float:
        """Mean voltage at the inputs that `mux`, 0 to 7, selects, from `begin` to `end` [s]."""
        along, across = self._weights[mux]
        with self._lock:
            self._swim(_steps(begin))
            first, last = self._now, max(_steps(end), _steps(begin) + 1)
            if last > first:  # else someone asked for a later state meanwhile
                x, y = self._swim(last)
                span = (last - first) * STEP
                self._conversion = (x / span, y / span)
            fx, fy = self._imperfections.apply(
                *self._conversion, end - self._start, max(end - begin, STEP)
            )
        settings = self._settings
        vx = settings.sensitivity * (fx + settings.crosstalk * fy) + settings.zero_x
        vy = settings.sensitivity * (fy + settings.crosstalk * fx) + settings.zero_y
        return along * vx + across * vy

    def catch_up(self, time: float) -> None:
        """Swim until `time` [s], where that is later than the state."""
        with self._lock:
            self._swim(_steps(time))

    def power(self, begin: float, end: float) -> float:
        """Mean electrical power of the servo from `begin` to `end` [s], recently [W].

        A conversion of the force sensor may be under way, for which the fish has yet to swim: the
        power is then that of a time as long, up to where the fish is.
        """
        with self._lock:
            self._swim(_steps(end - _LATE))
            last = min(self._now, _steps(end))
            first = min(last - 1, last - (_steps(end) - _steps(begin)))
            taken = self._taken(last) - self._taken(first)
        return taken / ((last - first) * STEP)

    def _taken(self, step: int) -> float:
        """What the servo had taken until a step of late [J]."""
        after = self._past[-1]
        for before in reversed(self._past):
            if before[0] <= step:
                length = after[0] - before[0]
                share = (step - before[0]) / length if length else 0.0
                return before[1] + share * (after[1] - before[1])
            after = before
        return after[1]

    def truth(self) -> Truth:
        """The true state at the end of the latest conversion."""
        with self._lock:
            state = self._fish.state
        return Truth(alpha=state.alpha, alpha_rate=state.alpha_rate, phi=state.phi)

    def angle(self, time: float) -> float | None:
        """The instruction angle [rad] that the pulse at a time [s] means; None without pulses."""
        width = self._pulse(time)
        return (width - self._settings.servo_centre) / self._settings.servo_scale if width else None

    def take_window(self) -> TrueWindow:
        """What the fish truly did since the previous call, or since the start."""
        with self._lock:
            duration = self._steps * STEP
            thrust = self._impulse / duration if duration else 0.0
            power = self._energy / duration if duration else 0.0
            window = TrueWindow(duration, thrust, self._fin_peak, power)
            self._steps, self._impulse, self._energy = 0, 0.0, 0.0
            self._fin_peak = abs(self._fish.state.alpha)
        return window

    def _swim(self, until: int) -> tuple[float, float]:
        """Swim until a step; the impulses of F_x and F_y on the way [N s]."""
        impulse_x = impulse_y = 0.0
        fish = self._fish
        while self._now < until:
            now = self._now
            angle = self._angle_at(now)
            end = self._change(angle, min(until, now + _PIECE))
            rate = fish.state.alpha_rate
            window = fish.advance(angle, (end - now) * STEP, 1)
            duration = window.duration
            self._steps += end - now
            self._now = end
            self._energy += (energy := window.power * duration)
            self._spent += energy
            self._past.append((end, self._spent))
            impulse_x += window.thrust * duration
            impulse_y += window.lateral_force * duration
            state = fish.state
            turned = rate * state.alpha_rate < 0.0  # only then is the peak within the window
            peak = window.fin_peak if turned else abs(state.alpha)
            if peak > self._fin_peak:
                self._fin_peak = peak
        self._impulse += impulse_x
        return impulse_x, impulse_y

    def _angle_at(self, step: int) -> float | None:
        return self.angle(step * STEP + _ROUNDING)

    def _change(self, angle: float | None, until: int) -> int:
        """The step, `until` at the latest, up to which the pulses still mean this angle."""
        if self._angle_at(until) == angle:
            return until
        same, other = self._now, until
        while other - same > 1:
            middle = (same + other) // 2
            if self._angle_at(middle) == angle:
                same = middle
            else:
                other = middle
        return other


def _steps(time: float) -> int:
    """Whole steps until a time, rounded down: nobody knows yet which pulses come later."""
    return math.floor((time + _ROUNDING) / STEP)


def _weights(name: str, settings: VirtualPiSettings) -> tuple[float, float]:
    """Shares of the two channels' voltages at an input.

    The first pin of a channel carries its voltage, pins that no channel uses are grounded.
    """
    if name == settings.channel_x:
        return 1.0, 0.0
    if name == settings.channel_y:
        return 0.0, 1.0
    plus, _, minus = name.partition("-")

    def share(channel: str) -> float:
        return float(channel[:2] == plus) - float(channel[:2] == minus)

    return share(settings.channel_x), share(settings.channel_y)
