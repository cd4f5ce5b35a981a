"""Dwell: a minimum time between reversals, with a fault for policies that keep violating it.

It applies to `ppo`, `remote` and of trainings, but not to `swing` and the
waveforms.
"""

import math
from collections import deque
from typing import Any

from fishd.controllers.base import Controller, Limits
from fishd.controllers.swing import Swing, SwingParameters
from fishd.core.errors import ControllerFault

NEUTRAL_FRACTION = 0.05
"""Fraction of the amplitude below which an angle counts as neutral."""
MAX_HELD_FRACTION = 0.5
"""Fraction of the ticks with a held reversal, of those in which it is possible, that is a fault."""
_ROUNDING_TICKS = 1e-3  # a sum of ticks is not exact


class Dwell:
    """Limit of the instruction angle: the dwell must pass between two changes of its side.

    Within a side, the angle is free. A reversal that is held back keeps the previous angle, or
    goes to neutral if the new one is neutral.
    """

    def __init__(self, dwell: float, tick: float, amplitude: float) -> None:
        """
        dwell: shortest time between two reversals [s]; 0 for no limit
        tick: period of the loop [s]
        amplitude: Φ of the limited controller [rad]
        """
        self.dwell = dwell
        self.held = False
        """Whether a reversal was held back in the latest tick."""
        self._tick = tick
        self._resting = NEUTRAL_FRACTION * amplitude
        self._instruction_angle = 0.0
        self._side = 0.0
        self._elapsed = 0.0
        """Time since the last reversal [s]."""

    def activate(self, instruction_angle: float) -> None:
        """Begin at the current angle [rad], as if the tail had just reversed."""
        self._instruction_angle = instruction_angle
        self._side = math.copysign(1.0, instruction_angle) if instruction_angle else 0.0
        self._elapsed = 0.0

    def apply(self, instruction_angle: float, dt: float) -> float:
        """Return the angle to send [rad], `dt` [s] after the previous one."""
        self._elapsed += dt
        self.held = False
        if not (self.dwell and math.isfinite(instruction_angle)):
            return instruction_angle
        side = math.copysign(1.0, instruction_angle) if instruction_angle else self._side
        if side != self._side:
            if self._side and self._elapsed < self.dwell - _ROUNDING_TICKS * self._tick:
                self.held = abs(instruction_angle) > self._resting
                instruction_angle = self._instruction_angle if self.held else 0.0
            else:
                self._side, self._elapsed = side, 0.0
        self._instruction_angle = instruction_angle
        return instruction_angle


class DwellLimit(Dwell):
    """Dwell that raises a fault for a policy that keeps commanding reversals too early."""

    def __init__(self, dwell: float, limits: Limits, amplitude: float) -> None:
        """Prepare the successor in advance, outside of a tick.

        dwell: see `Dwell`
        amplitude: Φ of the limited controller, and of its successor [rad]
        """
        super().__init__(dwell, limits.tick, amplitude)
        settings = limits.chatter
        self._patience = max(1, round(settings.patience / limits.tick))
        self._successor: tuple[str, Controller[Any]] | None = None
        if settings.fallback == "swing":
            self._successor = "swing", Swing(SwingParameters(amplitude=amplitude), limits)
        self._held: deque[bool] = deque()
        """Values of `held` in the latest ticks."""
        self._count = 0

    @property
    def share(self) -> float:
        """Fraction of the latest ticks, over the patience, in which a reversal was held back."""
        return self._count / self._patience

    def apply(self, instruction_angle: float, dt: float) -> float:
        """Return the angle to send [rad], like `Dwell.apply`.

        Raise `ControllerFault` with the code `chatter`, and a successor if configured, once
        reversals were held back for too long.
        """
        instruction_angle = super().apply(instruction_angle, dt)
        if self.dwell and math.isfinite(instruction_angle):
            self._watch(self.held)
        return instruction_angle

    def _watch(self, held: bool) -> None:
        self._held.append(held)
        self._count += held
        if len(self._held) > self._patience:
            self._count -= self._held.popleft()
        ticks = math.ceil(self.dwell / self._tick - _ROUNDING_TICKS)
        # A policy that reverses in every tick is held back in all but one tick of a dwell.
        max_count = MAX_HELD_FRACTION * self._patience * (ticks - 1) / ticks
        if ticks > 1 and len(self._held) == self._patience and self._count >= max_count:
            raise ControllerFault(
                "chatter",
                f"in {self._count} of the last {self._patience} ticks it wanted to reverse sooner "
                f"than {self.dwell:g} s after its last reversal",
                self._successor,
            )
