"""The thrust of the swimming fish with its 95 % interval, while the force sensor drifts.

Over whole beats, thrust is proportional to the mean square of the fin velocity, the power, which
does not drift: F_x = −Kαα̈ averages to K times the mean of α̇². The measured force is

    force = zero + factor · power + noise

In a steady swim every pair of zero and factor with the same sum explains the force equally well. So
a steady swim says nothing about the factor, however long it lasts; only a change of the power does:
from rest to swimming and back, from one wave or one amplitude to another. The factor is updated at
such changes alone, once for each, from the difference of the forces just before and just after it;
between two changes its variance only grows. docs/explanation/accuracy.md has the argument.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence

from fishd.control.estimators.thrust_factor import DRIFT_LAG_S, Drift, Factor, Level, Wave
from fishd.core.calibration import Z95
from fishd.core.estimation import PIECE_S, REST_SETTLE_TIME_S, SWIM_SETTLE_TIME_S
from fishd.core.signals import Observation

REST_DELAY_S = 2.5
"""Time without a movement of the tail after which it rests, whichever controller is active [s]."""
SHOWN_SPAN_S = 4.0
"""Longest time over which the shown thrust is averaged, in whole beats [s]."""
MAX_BEAT_S = 10.0
"""Time without a reversal after which a tail does not beat [s]."""
RETUNE_PAUSE_S = 4.0
"""Parameters may change more often than this; then beats count while the fin settles [s]."""
BEAT_SCATTER = 0.01
"""Half-width by which the factor differs from beat to beat of one wave, as a fraction of it."""
SIZE_STEP, SAME_SIZE = 0.2, 0.1
"""Change of the logarithm of speed or frequency that makes another size of a wave, and its largest
deviation within one size."""
CLEAR_STEP_SIGMAS = 5.0
"""Least change of the size, in standard deviations of the size of one block."""
JUMP_SIGMAS = 8.0
"""Number of standard deviations by which a spike or a step of the force differs from noise."""
MAX_CI95_N = 0.1
"""Largest half-width of a thrust that is shown as known [N]."""
MIN_BLOCKS, MAX_BLOCKS = 2, 8
"""Least and most blocks over which the force before or after a change is averaged."""
LONG_BLOCK_S = 1.0
"""One block of this length is enough, too [s]."""
MIN_DRIFT_LAG_S = 1.0
"""Shortest time over which the drift is observed [s]."""
INITIAL_NOISE_N = 1e-3
"""Standard deviation of the force of a block until two blocks have been compared [N]."""
MAX_NOISE_LAG = 4
"""Largest distance at which blocks are compared for their noise [blocks]."""
NOISE_MEMORY = 10
"""Number of comparisons over which the variance of blocks is averaged."""


class LiveThrust:
    """Thrust over the latest whole beats, and the half-width of its 95 % interval."""

    def __init__(self, zero_drift: float) -> None:
        """Start with nothing known.

        zero_drift: standard deviation of the change of the zero after a second, until the forces
            have shown how fast it drifts [N/√s]
        """
        self.thrust: float | None = None
        """Thrust of the latest beats; at rest, of its latest piece [N]. None while not known."""
        self.ci95 = 0.0
        """Half-width of the 95 % interval of `thrust` [N]."""
        self.factor: tuple[float, float] | None = None
        """Thrust over the mean square of `fin_velocity`, and the half-width of its interval [N].

        None while the half-width is larger than the factor."""
        self._factor = Factor()
        self._drift = Drift(zero_drift**2)
        self._swim_noise, self._rest_noise = _Noise(), _Noise()
        self._noise = self._rest_noise
        """Noise of a swim while it swims, else of a rest."""
        self._swims = self._recording = False
        self._wave: Wave = ("", {})
        self._now = self._phase = self._still = self._instruction_angle = self._side = 0.0
        self._settling_since = -math.inf
        self._block = _Block()
        self._shown: deque[_Block] = deque()
        """The latest blocks of the swim, no longer than `SHOWN_SPAN_S` in all."""
        self._run = _Run(None, self._factor)

    def forget_zero(self) -> None:
        """Discard all earlier forces: the zero of the sensor was set."""
        self._start_run(None)
        self._recording, self.thrust = False, None

    def forget(self) -> None:
        """Discard everything: the calibration of the sensor was changed."""
        self._factor, self.factor = Factor(), None
        self.forget_zero()

    def forget_factor(self) -> None:
        """Discard the factor, since the fin velocity has another scale from now on."""
        before = self._level()
        if before and before.power:  # its thrust stays known
            thrust, variance = self._thrust_of(before)
            before = before._replace(thrust=thrust, thrust_variance=variance, power=0.0)
        self._factor, self.factor = Factor(), None
        self._shown.clear()
        self._start_run(before)
        self._recording, self._phase = False, 0.0

    def interrupt(self) -> None:
        """Discard the open block: the latest force is suspect."""
        self._recording = False
        if self._swims:  # the fin velocity must settle again
            self._phase = 0.0
            if self._shown and self._now - self._shown[-1].end > MAX_BEAT_S:
                self._shown.clear()  # too old to be shown

    def calibrate(self, factor: float, ci95: float) -> None:
        """Set the factor to that of a measurement.

        factor: thrust over the mean square of `fin_velocity`
        ci95: half-width of its 95 % interval
        """
        size = self._size() or self._factor.size
        variance = (ci95 / Z95) ** 2
        self._factor = Factor(factor, variance, self._now, size, self._factor.wave)
        self._run.used = True  # that change, by the measurement
        if self._shown:
            self._show_beats()
        else:
            self._show_factor()

    def update(self, seen: Observation, running: bool, wave: Wave) -> None:
        """Take in a tick.

        running: whether a controller is active
        wave: the active controller and its parameters; a new object after each change
        """
        instruction_angle, self._now = seen.instruction_angle, seen.time
        self._still = 0.0 if instruction_angle != self._instruction_angle else self._still + seen.dt
        self._instruction_angle = instruction_angle
        swims = running and self._still < REST_DELAY_S
        if swims is not self._swims or (swims and wave is not self._wave):
            self._change(swims, wave)
        self._phase += seen.dt
        side = self._side
        if swims and instruction_angle:
            self._side = instruction_angle
        if not swims or side < 0.0 < instruction_angle:
            # The angle of this window follows a reversal: the beat ended with the window before.
            if self._recording:
                self._block.beats += 1
                if self._block.duration >= PIECE_S - 1e-9:
                    self._block.close(seen.time - seen.dt, swims)
                    self._recording = False
                    self._close(self._block)
            settle_time = SWIM_SETTLE_TIME_S if swims else REST_SETTLE_TIME_S
            if not self._recording and self._phase > settle_time:
                self._block, self._recording = _Block(), True
        if self._recording:
            self._block.add(seen)
            if self._block.duration > MAX_BEAT_S:
                self._recording = False
                self._shown.clear()
        if not (self._shown if swims else self._run.blocks):
            self._show_settling(seen)

    def _change(self, swims: bool, wave: Wave) -> None:
        """Begin a rest, a swim, or a swim of another controller."""
        goes_on = swims and self._swims and wave[0] == self._wave[0]
        self._swims, self._wave = swims, wave
        self._noise = self._swim_noise if swims else self._rest_noise
        if goes_on:  # in another phase, or with other parameters: their effect shows in the beats
            if self._now - self._settling_since > RETUNE_PAUSE_S:
                self._settling_since = self._now
                self._recording, self._phase = False, 0.0
            return
        self._settling_since = self._now
        self._start_run(self._level() or self._run.before)
        self._recording, self._phase, self._side = False, 0.0, 0.0
        self._shown.clear()
        self._show_factor()

    def _start_run(self, before: Level | None) -> None:
        """Begin a run; before: the level before it, None where that is not known."""
        self._run = _Run(before, self._factor)
        self._drift.start()

    def _close(self, block: "_Block") -> None:
        """Take in a block of whole beats, or a piece of a rest."""
        if self._swims:
            self._shown.append(block)
            while len(self._shown) > 1 and _duration(self._shown) > SHOWN_SPAN_S:
                self._shown.popleft()
        if not self._resizes(block) and not self._jumps(block):
            self._append(block)
        run = self._run
        if run.before and run.first and not run.used:
            run.started = run.started or len(run.first) >= self._count(block.duration)
            after = _level(run.first, self._noise)
            after = after._replace(variance=after.variance + run.jumped)
            self._factor = run.prior.after_step(run.before, after, self._drift.rate, run.wave)
        if self._swims:
            self._show_beats()
        else:
            self._show_rest(block)

    def _count(self, duration: float) -> int:
        """Return how many blocks of that duration [s] give the most certain mean.

        Fewer have more noise, more have more drift.
        """
        drift = self._drift.rate * duration
        best = math.sqrt(3.0 * self._noise.variance / drift) if drift else MAX_BLOCKS
        least = MIN_BLOCKS if duration < LONG_BLOCK_S else 1
        return round(max(least, min(MAX_BLOCKS, best)))

    def _level(self) -> Level | None:
        """Return the level at the end of the run; None where it has no block."""
        run = self._run
        if not run.blocks:
            return None
        count = self._count(run.blocks[-1].duration)
        level = _level(list(run.blocks)[-count:], self._noise)
        return level._replace(variance=level.variance + run.doubt)

    def _difference(self, block: "_Block", *others: "_Block") -> float:
        """Return the force of a block less that of others, the powers allowed for [N].

        others: the latest blocks of the run by default
        """
        difference = 0.0
        others = others or tuple(self._run.blocks)[-MIN_BLOCKS:]
        for other in others:
            power = block.power - other.power
            difference += block.force - other.force - self._factor.value * power
        return difference / len(others)

    def _jumps(self, block: "_Block") -> bool:
        """Set aside a block whose force jumps; begin again with the next one if it confirms that.

        Return True where the block is not to be appended to the run.
        """
        run = self._run
        if not run.blocks:
            return False
        odd, run.odd, run.doubt = run.odd, None, 0.0
        difference = self._difference(block)
        lag = block.end - run.blocks[-1].end
        limit = JUMP_SIGMAS**2 * (1.5 * self._noise.variance + self._drift.rate * lag)
        if difference**2 <= limit:
            return False  # and an odd block before it was a spike
        if odd is None:
            run.odd, run.doubt = block, difference**2
            return True
        if not run.started:
            run.jumped += difference**2
            if not self._swims:
                run.first.clear()
        run.blocks.clear()
        if self._difference(block, odd) ** 2 > limit:
            run.doubt = difference**2
        return False

    def _resizes(self, block: "_Block") -> bool:
        """Begin another run where the wave has another size, and keeps it.

        Return True where the block is not to be appended to the run.
        """
        run = self._run
        if block.size is None or run.size is None:
            return False
        limit = max(SIZE_STEP, CLEAR_STEP_SIGMAS * math.sqrt(self._noise.size_variance))
        if abs(block.size - run.size) <= limit:
            run.resized.clear()
            return False
        count = max(MIN_BLOCKS, self._count(block.duration))
        resized = run.resized = [*run.resized, block][-count:]
        mean = sum(other.size or 0j for other in resized) / len(resized)
        alike = all(abs((other.size or 0j) - mean) < SAME_SIZE for other in resized)
        if alike and len(resized) >= MIN_BLOCKS:
            self._start_run(self._level())
            for other in resized:
                self._append(other)
        return True

    def _append(self, block: "_Block") -> None:
        """Add a block to the run, and compare it with those before."""
        run, blocks = self._run, self._run.blocks
        if not blocks:
            run.wave = self._wave
        elif block.begin - blocks[-1].end < 0.5 * block.duration:
            size = abs(block.size - blocks[-1].size) if block.size and blocks[-1].size else 0.0
            self._noise.add([self._difference(block, other) for other in reversed(blocks)], size)
        self._compare(block)
        blocks.append(block)
        if block.size is not None:
            run.size = (
                block.size if run.size is None else run.size + (block.size - run.size) / len(blocks)
            )
        if not run.started:
            run.first.append(block)

    def _compare(self, block: "_Block") -> None:
        """Take in the change of the force from an earlier block of the run as a drift."""
        for other in self._run.blocks:
            lag = block.end - other.end
            if lag <= DRIFT_LAG_S + 1e-9:
                if lag >= MIN_DRIFT_LAG_S:
                    self._drift.add(self._difference(block, other), lag, self._noise.least)
                break

    def _size(self) -> complex | None:
        """Return the size of the shown beats; None where there are none."""
        return _level(tuple(self._shown), self._noise).size if self._shown else None

    def _thrust_of(self, level: Level) -> tuple[float, float]:
        """Return the thrust of a level [N], and its variance [N²]."""
        factor = self._run.prior if level is self._run.before else self._factor
        thrust = level.thrust + factor.value * level.power
        if not level.power:
            return thrust, level.thrust_variance
        return thrust, level.thrust_variance + factor.variance * level.power**2

    def _show(self, thrust: float, ci95: float) -> None:
        known = ci95 < MAX_CI95_N
        self.thrust, self.ci95 = (thrust, ci95) if known else (None, 0.0)

    def _show_factor(self) -> None:
        """Renew `factor`, for the shown beats where there are some."""
        factor = self._factor.at(self._now)
        wave = None if self._shown or not self._swims else self._wave
        spread = factor.variance + factor.scatter(self._size(), wave)
        ci95 = math.hypot(Z95 * math.sqrt(spread), BEAT_SCATTER * factor.value)
        self.factor = (factor.value, ci95) if ci95 < factor.value else None

    def _show_beats(self) -> None:
        self._show_factor()
        factor, beats = self._factor.at(self._now), _level(tuple(self._shown), self._noise)
        thrust = factor.value * beats.power
        spread = factor.variance + factor.scatter(beats.size)
        self._show(thrust, math.hypot(Z95 * beats.power * math.sqrt(spread), BEAT_SCATTER * thrust))

    def _show_rest(self, piece: "_Block") -> None:
        self._show_factor()
        level = self._level()
        assert level
        spread = level.variance + self._noise.variance + self._drift.rate * piece.duration
        self._show(piece.force - level.force, Z95 * math.sqrt(spread))

    def _show_settling(self, seen: Observation) -> None:
        """Show the force beyond the zero before the change, until beats or pieces are whole."""
        before, noise = self._run.before, self._noise.variance
        if before is None or (self._swims and not seen.frequency):
            self.thrust = None
            return
        thrust, spread = self._thrust_of(before)
        spread += before.variance + noise + self._drift.rate * (seen.time - before.end)
        force = seen.thrust - before.force + thrust if self._swims else 0.0
        self._show(force, Z95 * math.sqrt(spread))


class _Block:
    """Some whole beats of a swim, or a piece of a rest."""

    def __init__(self) -> None:
        self.duration = 0.0
        self.beats = 0
        self.begin = self.end = 0.0
        """[s]; these and the following are set by `close`."""
        self.force = 0.0
        """Mean F_x [N]."""
        self.power = 0.0
        """Mean square of the fin velocity; 0 at rest."""
        self.size: complex | None = None
        """Size of the wave, as in `Level`; None where the fin does not move."""
        self._impulse = self._energy = 0.0

    def add(self, seen: Observation) -> None:
        """Take in a tick."""
        dt = seen.dt
        self.duration += dt
        self._impulse += seen.fx * dt
        self._energy += seen.fin_velocity**2 * dt

    def close(self, end: float, swims: bool) -> None:
        """End the block at a time [s]."""
        self.begin, self.end = end - self.duration, end
        self.force = self._impulse / self.duration
        if swims and self._energy > 0.0:
            self.power = self._energy / self.duration
            self.size = _size(self.power, self.beats / self.duration)


class _Run:
    """Blocks of one wave of one size, or of one rest, and the level before them."""

    def __init__(self, before: Level | None, prior: Factor) -> None:
        self.before, self.prior = before, prior
        """The level and the factor before the change that began the run."""
        self.wave: Wave = ("", {})
        self.blocks: deque[_Block] = deque(maxlen=2 * MAX_BLOCKS)
        """The latest blocks."""
        self.size: complex | None = None
        """Mean size of the blocks; None at rest."""
        self.first: list[_Block] = []
        """The first blocks, which are compared with `before`."""
        self.used = False
        """Whether the change before the run must not be used."""
        self.started = False
        """Whether these are all of them."""
        self.resized: list[_Block] = []
        """Blocks of another size since the latest block of the run."""
        self.odd: _Block | None = None
        """The latest block, where its force jumped."""
        self.doubt = self.jumped = 0.0
        """Variances of the level now, and of the change before the run, by jumps [N²]."""


def _duration(blocks: Iterable[_Block]) -> float:
    """Return the time that some blocks take together [s]."""
    duration = 0.0
    for block in blocks:
        duration += block.duration
    return duration


def _level(blocks: Sequence[_Block], noise: "_Noise") -> Level:
    """Return the means over consecutive blocks."""
    duration = impulse = energy = 0.0
    beats = 0
    for block in blocks:
        duration += block.duration
        impulse += block.force * block.duration
        energy += block.power * block.duration
        beats += block.beats
    return Level(
        force=impulse / duration,
        variance=noise.variance / len(blocks),
        power=energy / duration,
        size=_size(energy / duration, beats / duration) if energy > 0.0 else None,
        begin=blocks[0].begin,
        end=blocks[-1].end,
    )


def _size(power: float, frequency: float) -> complex:
    return complex(0.5 * math.log(power), math.log(frequency))


class _Noise:
    """Variances of the force and of the size of blocks, from each to the next."""

    def __init__(self) -> None:
        self.variance = INITIAL_NOISE_N**2
        self.size_variance = 0.0
        self._variances = [self.variance] * MAX_NOISE_LAG
        self._count = 1

    @property
    def least(self) -> float:
        """Least variance of the force over some blocks: less where the beats repeat a pattern."""
        return min(self._variances)

    def add(self, forces: Sequence[float], size: float) -> None:
        """Take in the differences between a block and those before it, the latest first."""
        self._count = min(self._count + 1, NOISE_MEMORY)
        for lag, force in enumerate(forces[:MAX_NOISE_LAG]):
            self._variances[lag] += (0.5 * force**2 - self._variances[lag]) / self._count
        self.variance = self._variances[0]
        self.size_variance += (0.5 * size**2 - self.size_variance) / self._count
