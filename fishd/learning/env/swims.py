"""Short swims of policies in the tank, between rests in which the zero of the force is measured."""

from collections.abc import Callable

import numpy as np
from msgspec import Struct

from fishd.controllers.dwell import DwellLimit
from fishd.core.errors import ControllerFault
from fishd.core.estimation import REST_SETTLE_TIME_S, SWIM_SETTLE_TIME_S
from fishd.lab.measurement import Block, Sample, average_phase
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Decide, beat_frequency, is_stalled
from fishd.virtual.plant.optimum import best_square_wave

REST_TIME_S = REST_SETTLE_TIME_S + 1.0
"""Length of the rests before and after each swim [s]."""
MEASURED_TIME_S, MEASURED_BEATS = 2.0, 3.0
"""Time [s], and number of beats, for which a steady swim is measured; the longer of both counts."""
FIRST_BEATS = 1.5
"""Number of beats, of the best square wave, for which there is time before a policy may stall."""


class Stopped(Exception):
    """Signal that the measurement was stopped during a swim or a rest."""


class Swim(Struct, frozen=True):
    """The result of one swim of a policy."""

    thrust: float | None
    """Mean F_x over whole beats, less the zero of the sensor [N].

    None where the policy stalled, or too many ticks were lost.
    """
    frequency: float
    """Tail-beat frequency [Hz]."""
    fullness: float
    """Mean |φ_c|/Φ."""
    is_stalled: bool
    """Whether the policy does not swim, or violates the shortest dwell; then the swim is short."""
    seconds: float
    """Length of the swim [s]."""


class Swims:
    """Measured swims of policies, one after another, as with the controller `ppo`.

    The zero of the force sensor is interpolated between the rests before and after a swim, so a
    steady drift causes no error.
    """

    def __init__(self, env: SwimEnv, stop: Callable[[], bool]) -> None:
        """
        env: environment with an open episode, and not in a pause
        stop: called before each tick; True ends the swim there
        """
        self._env, self._stop, self._tick = env, stop, env.link.tick
        beat = 1.0 / best_square_wave(env.config.plant, env.link.amplitude).frequency
        first = max(SWIM_SETTLE_TIME_S, FIRST_BEATS * beat)
        longest = SWIM_SETTLE_TIME_S + max(MEASURED_TIME_S, MEASURED_BEATS * beat)
        self._parts = first, longest - first
        self._start = env.tank_time
        self._rested = False
        self._zero: Block | None = None
        """Mean forces of the latest rest; None where its ticks were lost."""

    def fits(self, seconds: float) -> bool:
        """Return whether there is time for another swim within `seconds` for all swims."""
        elapsed = self._env.tank_time - self._start
        return elapsed + sum(self._parts) + REST_TIME_S * (2 - self._rested) <= seconds + 1e-6

    def swim(self, decide: Decide) -> Swim:
        """Return the result of one swim, after which the fish rests, and before the first one, too.

        Raises `LinkLost` and `Stopped`.
        """
        if not self._rested:
            self._rest()
        before, phase = self._zero, list[Sample]()
        stalled = self._stalls(decide, phase)
        frequency, fullness = self._beat(phase)
        self._rest()
        block = average_phase(phase, self._tick, SWIM_SETTLE_TIME_S)
        if block and block.beats:
            frequency = block.beats / block.duration  # over whole beats, which is more exact
        thrust = None
        if block and before and self._zero and not stalled:
            share = (block.time - before.time) / (self._zero.time - before.time)
            thrust = block.force - before.force - share * (self._zero.force - before.force)
        return Swim(thrust, frequency, fullness, stalled, round(len(phase) * self._tick, 9))

    def _stalls(self, decide: Decide, phase: list[Sample]) -> bool:
        """Swim, and return True as soon as the policy stalls; add the ticks to `phase`."""
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
        """Return the tail-beat frequency [Hz], and the mean |φ_c|/Φ."""
        shares = np.array([sample.phi_c for sample in phase] or [0.0]) / self._env.link.amplitude
        return beat_frequency(shares, self._tick), float(np.mean(np.abs(shares)))

    def _rest(self) -> None:
        phase = list[Sample]()
        for _ in range(round(REST_TIME_S / self._tick)):
            self._step(0.0, False, phase)
        self._zero, self._rested = average_phase(phase, self._tick, REST_SETTLE_TIME_S), True

    def _step(self, angle: float, swims: bool, phase: list[Sample]) -> None:
        """Swim one tick at an angle [rad], and add it to a phase; raises `Stopped`."""
        if self._stop():
            raise Stopped
        latest = self._env.latest
        phase.append(
            Sample(round(latest.time / self._tick), latest.fx, latest.fin_velocity, angle, swims)
        )
        self._env.advance(angle)
