"""The thrust of the fish as it swims, and how well it is known while the force sensor drifts.

Over whole beats, thrust is proportional to the mean square of the fin velocity, and that is free of
drift: F_x = −Kαα̈ averages to K times the mean of α̇². The factor is not known beforehand. Two
numbers are tracked by a Kalman filter, from the mean force of each beat and of each piece of a
rest: the force that the sensor shows without any thrust, its zero, which wanders; and the factor,
which hardly does. So each rest makes the thrust known, and each change between rest and swimming
makes it better known.
"""

import math
from collections import deque
from typing import Any

from fishd.core.signals import Observation

SWIM_SETTLES = 1.5
"""The fin swims steadily after so long [s]."""
REST_SETTLES = 1.0
"""The fin hangs still after so long, fading included [s]."""
STILL = 2.5
"""A tail that has not been moved for so long rests, whoever has command [s]."""
PIECE = 0.5
"""A rest is cut in pieces of this length, and beats are taken together until they last so [s]."""
SPAN = 4.0
"""The thrust is that of the latest beats, of no more than this in all [s]."""
LONGEST_BEAT = 10.0
"""A tail that has not reversed for so long does not beat [s]."""
FACTOR_WALKS = 0.002
"""How fast the factor becomes uncertain: share of it, standard deviation after a second."""
SHAPE = 0.01
"""The factor is not the same for every beat of a wave: it differs by this share."""
OTHER_WAVE = 0.3
"""Nor for every wave, where `estimator.leak` is not that of the fish: standard deviation, a share
of it. The zero is still known when the wave changes, so the factor is soon known again."""
OTHER_SIZE = 0.12
"""Nor for a wave of another amplitude or frequency: standard deviation, a share of it for each
e-fold of the fin's speed or of the frequency (rms of 40 random simulated fish)."""
INTERVAL = 1.96
"""Half of a 95 % interval, over the standard deviation."""
BROKEN = 8.0
"""A force at rest so many standard deviations off is no drift: by so much the zero is uncertain."""
WANDER_FADES = 0.9
"""What rests showed of a faster drift counts this much less with each further rest."""
UNKNOWN = 1.0
"""Standard deviation of a zero that nothing is known of, and of a thrust [N]."""
MOST_KNOWN = 0.1
"""A thrust that is known no better than this is not known [N]."""
_NOISE = 1e-3
"""What blocks are thought to vary by until there are two to compare [N]."""
_COMPARISONS = 10
"""How many comparisons of blocks the variance of blocks remembers."""


Wave = tuple[str, dict[str, Any]]
"""A controller's name, and its parameters."""


class LiveThrust:
    """Thrust over the latest whole beats, and half of its 95 % interval."""

    def __init__(self, zero_drift: float) -> None:
        """zero_drift: how fast the zero wanders, standard deviation after a second [N/√s].

        Where rests show that it wanders faster, that is taken instead.
        """
        self.thrust: float | None = None
        """Of the latest beats; at rest, of the latest piece of it [N]. None while not known."""
        self.error = 0.0
        """Half of its 95 % interval [N]."""
        self._least_wander = self._wander = zero_drift**2
        self._zero = self._factor = 0.0
        self._zero_variance, self._covariance = UNKNOWN**2, 0.0
        self._factor_variance: float | None = None
        self._anchored = False
        """Is the zero known, or a factor from when it was?"""
        self._time = self._rested = -math.inf
        self._at_rest = 0.0
        self._noises = {True: _Noise(), False: _Noise()}
        self._swims = False
        self._wave: Wave = ("", {})
        self._factor_wave: Wave | None = None
        """Which wave the factor was found from."""
        self._size: complex | None = None
        """Logarithm of the fin's speed in the latest beat, and i times that of its frequency."""
        self._factor_size: complex | None = None
        """The same of the beats that the factor was found from."""
        self._angle = self._still = 0.0
        self._phase = 0.0
        self._side = 0.0
        self._block: _Block | None = None
        self._beats: deque[_Block] = deque()
        self._power = 0.0

    def forget_zero(self) -> None:
        """The sensor's zero was set: find it anew, in the next rest."""
        self._zero_variance, self._covariance = UNKNOWN**2, 0.0
        self._block = self.thrust = None

    def forget(self) -> None:
        """The sensor's calibration was changed: nothing found so far holds."""
        self._factor, self._factor_variance, self._anchored = 0.0, None, False
        self._factor_size = None
        self.forget_zero()

    def forget_factor(self) -> None:
        """The fin velocity has another scale from now on; the zero is what it was."""
        self._factor, self._factor_variance, self._covariance = 0.0, None, 0.0
        self._block = None
        self._beats.clear()

    def interrupt(self) -> None:
        """The latest force is not to be believed: its beat, or piece of a rest, does not count."""
        self._block = None
        if self._swims:  # the fin velocity settles anew
            self._phase = 0.0

    def calibrate(self, factor: float, error: float) -> None:
        """Take the factor from a measurement.

        factor: thrust over the mean square of `fin_velocity`
        error: half of its 95 % interval
        """
        self._factor, self._factor_variance = factor, (error / INTERVAL) ** 2
        self._anchored, self._covariance = True, 0.0
        self._factor_size = self._size

    @property
    def factor(self) -> tuple[float, float] | None:
        """Thrust over the mean square of `fin_velocity`, and half of its 95 % interval [N].

        None while the error is larger than the factor.
        """
        if self._factor_variance is None or not self._anchored:
            return None
        spread = math.sqrt(self._factor_variance + self._of_size)
        error = math.hypot(INTERVAL * spread, SHAPE * self._factor)
        return (self._factor, error) if error < self._factor else None

    def update(self, seen: Observation, running: bool, wave: Wave) -> None:
        """Take in a tick.

        running: is a controller active?
        wave: which one it is, and with which parameters; another object where it is another one
        """
        moved = seen.instruction_angle != self._angle
        self._still = 0.0 if moved else self._still + seen.dt
        self._angle = seen.instruction_angle
        swims = running and self._still < STILL
        if swims != self._swims or (swims and wave is not self._wave):
            self._swims, self._wave, self._phase, self._side = swims, wave, 0.0, 0.0
            self._block = None
            self._beats.clear()
            self._at_rest = 0.0
            self._noises[swims].forget()  # there was drift since
            if swims:
                self._take_up(wave)
        self._phase += seen.dt
        # Of the instruction angle during this window: a beat ends with the window before it.
        ends = self._reversed(seen.instruction_angle) if swims else True
        if ends and self._block:
            self._block.beats += 1
        if ends and self._block and self._block.lasts >= PIECE - 1e-9:
            self._close(self._block, seen.time - seen.dt)
            self._block = None
        if ends and not self._block and self._phase > (SWIM_SETTLES if swims else REST_SETTLES):
            self._block = _Block()
        if self._block:
            self._block.add(seen)
            if self._block.lasts > LONGEST_BEAT:
                self._block = None
                self._beats.clear()
        self._know(seen)

    def _take_up(self, wave: Wave) -> None:
        """Another wave than that of the factor makes the factor uncertain."""
        other = self._factor_wave is not None and wave != self._factor_wave
        if other and self._factor_variance is not None:
            self._factor_variance += (OTHER_WAVE * self._factor) ** 2
            self._factor_size = None  # its size is in that already
        self._factor_wave = wave

    def _reversed(self, angle: float) -> bool:
        """Has the instruction angle become positive?"""
        before = self._side
        if angle:
            self._side = math.copysign(1.0, angle)
        return before < 0.0 < self._side

    def _close(self, block: "_Block", time: float) -> None:
        """Learn from a block that ended at `time` [s]."""
        power = 0.0
        if self._swims:
            power = block.power
            self._beats.append(block)
            while len(self._beats) > 1 and sum(beat.lasts for beat in self._beats) > SPAN:
                self._beats.popleft()
            lasts = sum(beat.lasts for beat in self._beats)
            self._power = sum(beat.power * beat.lasts for beat in self._beats) / lasts
            if power > 0.0:
                frequency = block.beats / block.lasts
                self._size = complex(0.5 * math.log(power), math.log(frequency))
            if self._factor_variance is None and power > 0.0:
                self._factor_variance = (UNKNOWN / power) ** 2
        else:
            self._anchored = True
        self._wait(time)
        noise, before = self._noises[self._swims], self._factor_variance
        if self._factor_size is None:
            self._factor_size = self._size
        shape = self._of_size * power**2
        if self._learn(block.force, power, noise.variance + shape):
            noise.compare(block.force)
        else:
            noise.forget()
        if power > 0.0 and before:
            self._move_size(1.0 - (self._factor_variance or 0.0) / before)
        self._at_rest = block.force - self._zero
        if not self._swims:
            self._rested = time

    @property
    def _of_size(self) -> float:
        """Variance that the factor has for the latest beats, as it is of beats of another size."""
        if self._size is None or self._factor_size is None:
            return 0.0
        return (OTHER_SIZE * abs(self._size - self._factor_size) * self._factor) ** 2

    def _move_size(self, learnt: float) -> None:
        """The factor is now by so large a share that of the latest beat."""
        if self._size is not None and self._factor_size is not None:
            self._factor_size += learnt * (self._size - self._factor_size)

    def _wait(self, time: float) -> None:
        """What is known becomes less certain with time."""
        passed = max(0.0, time - self._time) if self._time > -math.inf else 0.0
        self._time = time
        self._zero_variance += self._wander * passed
        if self._factor_variance is not None:
            self._factor_variance += (FACTOR_WALKS * self._factor) ** 2 * passed

    def _learn(self, force: float, power: float, variance: float) -> bool:
        """A step of the filter: force = zero + factor * power + noise of that variance.

        False where the zero has jumped, or this was a spike: what comes next will tell.
        """
        a, b, c = self._zero_variance, self._covariance, self._factor_variance or 0.0
        surprise = force - self._zero - self._factor * power
        along, across = a + b * power, b + c * power
        total = along + across * power + variance
        if power == 0.0 and surprise**2 > BROKEN**2 * total:
            self._zero_variance += surprise**2
            return False
        gap = self._time - self._rested
        if power == 0.0 and 2.0 * PIECE < gap < math.inf:  # a swim was between
            more = surprise**2 - total if surprise**2 > INTERVAL**2 * total else 0.0
            self._wander = max(self._least_wander, WANDER_FADES * self._wander + more / gap)
        self._zero += along / total * surprise
        self._factor += across / total * surprise
        self._zero_variance = max(0.0, a - along * along / total)
        self._covariance = b - along * across / total
        if self._factor_variance is not None:
            self._factor_variance = max(0.0, c - across * across / total)
        return True

    def _know(self, seen: Observation) -> None:
        """Thrust and error now."""
        passed = seen.time - self._time
        if self._swims and self._beats and self._factor_variance is not None:
            thrust = self._factor * self._power
            spread = self._factor_variance + (FACTOR_WALKS * self._factor) ** 2 * passed
            spread += self._of_size
            error = math.hypot(INTERVAL * self._power * math.sqrt(spread), SHAPE * thrust)
        elif not self._swims:
            thrust = self._at_rest
            spread = self._zero_variance + self._wander * passed + self._noises[False].variance
            error = INTERVAL * math.sqrt(spread)
        elif seen.frequency:  # the first beats, or the first of another wave
            thrust = seen.thrust - self._zero
            spread = self._zero_variance + self._wander * passed + self._noises[True].variance
            error = INTERVAL * math.sqrt(spread)
        else:
            thrust, error = 0.0, math.inf
        known = self._anchored and error < MOST_KNOWN
        self.thrust, self.error = (thrust, error) if known else (None, 0.0)


class _Block:
    """Sums of a whole beat, or of a piece of a rest."""

    def __init__(self) -> None:
        self.lasts = 0.0
        self.beats = 0
        self._impulse = self._energy = 0.0

    def add(self, seen: Observation) -> None:
        self.lasts += seen.dt
        self._impulse += seen.fx * seen.dt
        self._energy += seen.fin_velocity**2 * seen.dt

    @property
    def force(self) -> float:
        """Mean F_x [N]."""
        return self._impulse / self.lasts

    @property
    def power(self) -> float:
        """Mean square of the fin velocity."""
        return self._energy / self.lasts


class _Noise:
    """Variance of the force of blocks, from one to the next, so that hardly any drift is in it."""

    def __init__(self) -> None:
        self.variance = _NOISE**2
        self._count = 1
        self._before: float | None = None

    def compare(self, force: float) -> None:
        """Take in the force of another block."""
        if self._before is not None:
            found = 0.5 * (force - self._before) ** 2
            self._count = min(self._count + 1, _COMPARISONS)
            self.variance += (found - self.variance) / self._count
        self._before = force

    def forget(self) -> None:
        """The next block is not to be compared with those before."""
        self._before = None
