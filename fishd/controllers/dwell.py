"""Holds back reversals that come too soon, and gives command away where a policy insists on them.

`ppo` and `remote` pass their commands through it, and whoever learns; `swing` and the waveforms do
not.
"""

import math
from collections import deque
from typing import Any

from fishd.controllers.base import Controller, Limits
from fishd.controllers.swing import Swing, SwingParameters
from fishd.core.errors import ControllerFault

RESTING = 0.05
"""An angle below this share of the amplitude is as good as neutral."""
MOST = 0.5
"""To be held back in this share of the ticks in which that can be is to fight the limit."""
_ROUNDING = 1e-3  # in ticks; a sum of ticks is not exact


class Dwell:
    """Lets a command change its side of neutral no sooner than the dwell after it last did.

    Within a side it may do what it likes. What is held back stays at the angle of before, or goes
    to neutral where it wants to rest there.
    """

    def __init__(self, dwell: float, tick: float, amplitude: float) -> None:
        """
        dwell: the shortest time between two reversals [s]; 0 holds nothing back
        tick: period of the loop [s]
        amplitude: Φ of who is limited [rad]
        """
        self.dwell = dwell
        self.held = False
        """Was a reversal held back, in the latest tick?"""
        self._tick = tick
        self._resting = RESTING * amplitude
        self._angle = 0.0
        self._side = 0.0
        self._elapsed = 0.0
        """Since the last reversal [s]."""

    def activate(self, angle: float) -> None:
        """Begin at the present angle [rad], as if the tail had reversed just now."""
        self._angle = angle
        self._side = math.copysign(1.0, angle) if angle else 0.0
        self._elapsed = 0.0

    def apply(self, angle: float, dt: float) -> float:
        """The angle to command [rad], `dt` s after the one before."""
        self._elapsed += dt
        self.held = False
        if not (self.dwell and math.isfinite(angle)):
            return angle
        side = math.copysign(1.0, angle) if angle else self._side
        if side != self._side:
            if self._side and self._elapsed < self.dwell - _ROUNDING * self._tick:
                self.held = abs(angle) > self._resting
                angle = self._angle if self.held else 0.0
            else:
                self._side, self._elapsed = side, 0.0
        self._angle = angle
        return angle


class DwellLimit(Dwell):
    """A dwell that loses patience with who insists on reversals that it holds back."""

    def __init__(self, dwell: float, limits: Limits, amplitude: float) -> None:
        """Builds who may take over, so that no tick has to.

        dwell: as for `Dwell`
        amplitude: Φ of the controller that is limited, and of the one that may take over [rad]
        """
        super().__init__(dwell, limits.tick, amplitude)
        settings = limits.chatter
        self._patience = max(1, round(settings.patience / limits.tick))
        self._successor: tuple[str, Controller[Any]] | None = None
        if settings.fallback == "swing":
            self._successor = "swing", Swing(SwingParameters(amplitude=amplitude), limits)
        self._held: deque[bool] = deque()
        """`held`, of the latest ticks."""
        self._count = 0

    @property
    def share(self) -> float:
        """In what share of the latest ticks, as many as patience has, a reversal was held back."""
        return self._count / self._patience

    def apply(self, angle: float, dt: float) -> float:
        """As `Dwell.apply`.

        Raises `ControllerFault` with the code `chatter`, and who takes over if anyone does, once
        reversals were held back for too long.
        """
        angle = super().apply(angle, dt)
        if self.dwell and math.isfinite(angle):
            self._watch(self.held)
        return angle

    def _watch(self, held: bool) -> None:
        self._held.append(held)
        self._count += held
        if len(self._held) > self._patience:
            self._count -= self._held.popleft()
        ticks = math.ceil(self.dwell / self._tick - _ROUNDING)
        # Of so many ticks of dwell, who always wants to reverse is held back in all but one.
        most = MOST * self._patience * (ticks - 1) / ticks
        if ticks > 1 and len(self._held) == self._patience and self._count >= most:
            raise ControllerFault(
                "chatter",
                f"in {self._count} of the last {self._patience} ticks it wanted to reverse sooner "
                f"than {self.dwell:g} s after its last reversal",
                self._successor,
            )
