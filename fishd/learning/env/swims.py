"""Short swims of policies in the tank, between rests that show the zero of the force sensor."""

from collections.abc import Callable

import numpy as np
from msgspec import Struct

from fishd.control.estimators.live_thrust import REST_SETTLE_TIME_S, SWIM_SETTLE_TIME_S
from fishd.controllers.dwell import DwellLimit
from fishd.core.errors import ControllerFault
from fishd.lab.measurement import Block, Sample, block_of
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Decide, beat_frequency, is_stalled
from fishd.virtual.plant.optimum import best_square_wave

REST = REST_SETTLE_TIME_S + 1.0
"""How long the fish rests before and after each swim [s]."""
MEASURED, BEATS = 2.0, 3.0
"""A swim that is steady is measured for so long [s], or for so many beats where that is longer."""
FIRST_BEATS = 1.5
"""It is not said to stall before it has had time for so many beats."""


class Stopped(Exception):
    """It was to be stopped in the middle of a swim or of a rest."""


class Swim(Struct, frozen=True):
    """How a policy swam once."""

    thrust: float | None
    """Mean F_x over whole beats, less the zero of the sensor [N].

    None where the policy stalled, or too many ticks were lost to tell.
    """
    frequency: float
    """Tail beats per second [Hz]."""
    fullness: float
    """Mean |φ_c|/Φ."""
    stalled: bool
    """It does not swim, or leans on the shortest dwell; it was stopped after about two seconds."""
    seconds: float
    """How long it swam [s]."""


class Swims:
    """Lets policies swim the fish that learns, one after the other, as the controller `ppo` does.

    The zero of the force sensor is interpolated between the rests before and after a swim, so a
    steady drift is no error.
    """

    def __init__(self, env: SwimEnv, stop: Callable[[], bool]) -> None:
        """
        env: an episode has begun in it, and it is not in a pause
        stop: called before each tick; True ends it there
        """
        self._env, self._stop, self._tick = env, stop, env.link.tick
        beat = 1.0 / best_square_wave(env.config.plant, env.link.amplitude).frequency
        first = max(SWIM_SETTLE_TIME_S, FIRST_BEATS * beat)
        longest = SWIM_SETTLE_TIME_S + max(MEASURED, BEATS * beat)
        self._parts = first, longest - first
        self._begun = env.tank_time
        self._rested = False
        self._zero: Block | None = None
        """Of the latest rest; None where its ticks were lost."""

    def fits(self, seconds: float) -> bool:
        """Is there time for one more, if all of them may take so long [s]?"""
        elapsed = self._env.tank_time - self._begun
        return elapsed + sum(self._parts) + REST * (2 - self._rested) <= seconds + 1e-6

    def swim(self, decide: Decide) -> Swim:
        """One swim, and a rest after it; before the first one, too.

        Raises `LinkLost` and `Stopped`.
        """
        if not self._rested:
            self._rest()
        before, phase = self._zero, list[Sample]()
        stalled = self._stalls(decide, phase)
        frequency, fullness = self._beat(phase)
        self._rest()
        found = block_of(phase, self._tick, SWIM_SETTLE_TIME_S)
        if found and found.beats:
            frequency = found.beats / found.lasts  # of whole beats: more exact
        thrust = None
        if found and before and self._zero and not stalled:
            share = (found.time - before.time) / (self._zero.time - before.time)
            thrust = found.force - before.force - share * (self._zero.force - before.force)
        return Swim(thrust, frequency, fullness, stalled, round(len(phase) * self._tick, 9))

    def _stalls(self, decide: Decide, phase: list[Sample]) -> bool:
        """Let it swim, to the end only where it does swim; the ticks are added to `phase`."""
        env, limits = self._env, self._env.config.limits
        limit = DwellLimit(limits.dwell if env.settings.dwell else 0.0, limits, env.link.amplitude)
        try:
            for seconds in self._parts:
                for _ in range(round(seconds / self._tick)):
                    angle = limit.apply(decide(env.latest, env.stack), self._tick)
                    self._step(angle, True, phase)
                if is_stalled(*self._beat(phase), self._tick):
                    return True
        except ControllerFault:  # `ppo` would hand over to another controller
            return True
        return False

    def _beat(self, phase: list[Sample]) -> tuple[float, float]:
        """Frequency [Hz], and fullness."""
        shares = np.array([each.phi_c for each in phase] or [0.0]) / self._env.link.amplitude
        return beat_frequency(shares, self._tick), float(np.mean(np.abs(shares)))

    def _rest(self) -> None:
        phase = list[Sample]()
        for _ in range(round(REST / self._tick)):
            self._step(0.0, False, phase)
        self._zero, self._rested = block_of(phase, self._tick, REST_SETTLE_TIME_S), True

    def _step(self, angle: float, swims: bool, phase: list[Sample]) -> None:
        """One tick at an angle [rad], which is added to a phase."""
        if self._stop():
            raise Stopped
        seen = self._env.latest
        phase.append(
            Sample(round(seen.time / self._tick), seen.fx, seen.fin_velocity, angle, swims)
        )
        self._env.advance(angle)
