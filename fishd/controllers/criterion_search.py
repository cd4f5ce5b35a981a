"""Search for the C with which `swing` has the largest thrust, by trials of neighbouring values.

Two measures of the thrust are compared, the ripple and the mean of F_x. A fin that swings as
α = A sin ωt gives F_x = −Kαα̈ = ½KA²ω² (1 − cos 2ωt): the force has a ripple at twice the beat
frequency, whose amplitude equals its mean. The ripple does not drift with the sensor, but other
shapes of the beat have a ripple that is a few percent larger or smaller for the same thrust. The
mean is the thrust itself, but drifts. The difference of a trial from the gait before and after it
is free of a steady drift, and the change of the zero from before a trial to after it measures the
drift. Each measure is weighted by its uncertainty: on a rig with little drift the mean decides, on
others the ripple.

The part of F_y that a turned sensor adds is subtracted first, so the sign of F_y does not matter.

A C whose ripple does not rise above the noise is not taken; if none does, C stays at 0.6.
"""

import logging
import math
from collections import deque
from enum import Enum
from typing import NamedTuple

log = logging.getLogger(__name__)

Forces = tuple[float, float]
"""F_x and F_y [N]."""


class Rung(NamedTuple):
    """Criterion of a reversal."""

    C: float
    """Fraction of the fin's last maximum speed at which to reverse."""
    lead: float = 0.0
    """Time by which the compared speed is predicted ahead [s]."""


LADDER = (
    *(Rung(C) for C in (0.0, 0.2, 0.4, 0.6, 0.75, 0.9, 0.98)),
    *(Rung(0.95, lead) for lead in (0.05, 0.1, 0.2, 0.4)),
)
"""Criteria from late to early reversals. A slow servo, or a fin with strong damping, needs
reversals before the fin reaches its maximum speed."""
START_INDEX = LADDER.index(Rung(0.6))
"""Index of the first rung."""
TRIAL_BEATS = 3
"""Number of whole beats of a trial, after one beat in which the fin settles."""
MIN_GAIN = 0.01
"""Relative gain above which a rung replaces the current one [1]."""
RIPPLE_BIAS = 0.04
"""Standard deviation of the ripple's gain from the thrust's, since gaits differ in shape [1]."""
UNSTEADY_DRIFT_FRACTION = 0.25
"""Deviation of the zero within a trial from the mean of before and after, as a fraction of its
change from before to after: the unsteady part of the drift [1]."""
MAX_MOVES = 8
"""Number of latest trials whose changes of the zero are kept."""
INITIAL_DRIFT = 0.03
"""Additional deviation of the zero in the first trials, as a fraction of the ripple [1]."""
MIN_STANDARD_ERRORS = 1.0
"""Number of standard errors by which a gain must differ from `MIN_GAIN`; else repeat the trial."""
MAX_ROUNDS = 3
"""Maximum number of repetitions of a trial."""
MIN_TRIAL_RATIO = 0.8
"""Ratio of the ripple to the reference below which a trial ends after one beat."""
MIN_CLEAR = 8
"""Number of consecutive clear ripples after which a search that found none begins again."""
CLEAR_RATIO, NOISE_MEMORY = 2.0, 40
"""Ratio of the mean squares of a clear ripple and of its noise, and number of measurements over
which that noise is averaged."""
LOST_RATIO = 0.5
"""Ratio of the ripple to its former value below which a gait is lost: the tail only trembles."""
LAUNCH_HALF_BEATS = 4
"""Number of half beats with the latest reversals that restart a lost gait."""
SAME_GAIT_TOLERANCE = 0.03
"""Relative difference of half beats below which two rungs give the same gait, so that the next
rung is tried."""
RETRY_INTERVAL_S = 40.0
"""Time until the next trial, once all neighbours are worse [s]."""
MIN_CHANGE = 0.25
"""Relative change of the ripple above which the fish counts as changed: the search restarts [1]."""
MIN_CHANGE_STANDARD_ERRORS = 3.0
"""Number of standard errors that such a change of the ripple must exceed, too."""
MAX_STEP = 8
"""Largest step of a trial on the ladder [half steps]."""
NEIGHBOUR_STEPS = (2, -2, 4, -4, 1, -1)
"""Steps that are tried, in this order [half steps]. Halfway between two rungs, one side uses one
rung and the other side the other: with few ticks per half beat, the optimum may lie between."""


class Judgement(NamedTuple):
    """Measurement of several beats by the force."""

    ripple: float
    """Ripple of F_x, rms [N]."""
    error: float
    """Standard error of `ripple` [N]."""
    half_beat: float
    """Mean duration of a half beat [s]."""
    level: float
    """Mean of F_x: the thrust plus the zero of the sensor [N]."""
    level_error: float
    """Standard error of `level` without drift [N]."""
    is_clear: bool
    """Whether the ripple rises above the noise."""


class Gain(NamedTuple):
    """Relative gain of a trial over the mean of the gaits before and after it."""

    ripple: float
    """Gain by the ripple [1]."""
    ripple_variance: float
    level: float
    """Gain by the mean of F_x [1]."""
    level_variance: float


def compare_gaits(before: Judgement, trial: Judgement, after: Judgement) -> Gain:
    """Return the gain of a trial, relative to the thrust: √2 times the ripple of a sine."""
    ripple = 0.5 * (before.ripple + after.ripple)
    level = 0.5 * (before.level + after.level)
    noise = trial.error**2 + 0.25 * (before.error**2 + after.error**2)
    level_noise = trial.level_error**2 + 0.25 * (before.level_error**2 + after.level_error**2)
    thrust = math.sqrt(2.0) * ripple
    return Gain(
        trial.ripple / ripple - 1.0,
        noise / ripple**2,
        (trial.level - level) / thrust,
        level_noise / thrust**2,
    )


class Phase(Enum):
    """State of the search."""

    BEFORE = "before a trial"
    TRIAL = "a trial"
    AFTER = "after a trial"
    WATCH = "watching"
    LAUNCH = "beginning a lost gait again"


class CriterionSearch:
    """Search for the best rung from the force of each tick."""

    def __init__(self) -> None:
        from fishd.controllers.ripple import (
            compute_ripples,  # imports numpy, which fishctl does not need
        )

        self._ripples = compute_ripples
        self.ripple = 0.0
        """Ripple of the latest beats [N]."""
        self.is_clear = True
        self._clear_in_a_row = 0
        """Whether the ripple rose above the noise at the end of the latest search."""
        self._noise = 0.0  # mean square of the noise in the ripple [N²]
        self._noise_count = 0
        self._place = self._former = 2 * START_INDEX  # current and previous place [half steps]
        self._avoided: set[int] = set()  # places where a gait was lost, or is much worse
        self._lost = 0.0  # former ripple of a lost gait
        self._trials = list(NEIGHBOUR_STEPS)
        self._turn = 0
        self._reference = self._trial = Judgement(0.0, 0.0, 0.0, 0.0, 0.0, False)
        self._gains: list[Gain] = []  # gain of this trial in each round
        self._moves: deque[float] = deque(maxlen=MAX_MOVES)  # changes of the zero [N]
        self._known = 0.0
        self._watched = 0.0
        self._side = 0.0
        self._forces: list[Forces] = []
        self._begin(Phase.BEFORE)

    @property
    def rung(self) -> Rung:
        """The rung for the current tick."""
        place = self._in_use
        return LADDER[(place + 1) // 2 if self._side > 0.0 else place // 2]

    @property
    def halfway(self) -> bool:
        """Whether the two sides use two different rungs."""
        return self._in_use % 2 == 1

    @property
    def _in_use(self) -> int:
        """Current place on the ladder [half steps]."""
        if self.phase is Phase.LAUNCH:
            return 0
        return self._place + (self._trials[0] if self.phase is Phase.TRIAL else 0)

    def update(self, fx: float, fy: float, dt: float, side: float) -> None:
        """Process a tick.

        fx, fy: mean forces since the previous tick [N]
        dt: time since then [s]
        side: sign of the instruction angle since then
        """
        self._watched += dt
        if side != self._side:
            if self._forces:
                self._close_half(self._forces, dt * len(self._forces))
            self._side, self._forces = side, []
        self._forces.append((fx, fy))

    def _begin(self, phase: Phase) -> None:
        self.phase = phase
        self._skip = 2  # number of half beats in which the fin settles
        self._start_sums()

    def _start_sums(self) -> None:
        self._halves: list[list[Forces]] = []
        self._lasted = 0.0

    def _close_half(self, forces: list[Forces], duration: float) -> None:
        if self._skip:
            self._skip -= 1
            return
        self._lasted += duration
        self._halves.append(forces)
        if len(self._halves) < 2:
            return
        gait = self._gait()
        is_worse = (
            self.phase is Phase.TRIAL and gait.ripple < MIN_TRIAL_RATIO * self._reference.ripple
        )
        required_half_beats = LAUNCH_HALF_BEATS if self.phase is Phase.LAUNCH else 2 * TRIAL_BEATS
        if len(self._halves) >= required_half_beats or is_worse:
            self._judge(gait)

    def _gait(self) -> Judgement:
        """Return the measurement over the half beats since the phase began."""
        squares, noises, levels = self._ripples(self._halves)
        middle = _median(squares)
        half_beat = self._lasted / len(self._halves)
        self.ripple = math.sqrt(middle)
        scatter = 1.25 * _mean([abs(value - middle) for value in squares])
        # Error of the root. Each half beat is in two values, so their number counts for two thirds;
        # the error of a median is a quarter larger than that of a mean.
        error = (
            0.5 * 1.25 * scatter * math.sqrt(1.5 / len(squares)) / self.ripple if middle else 0.0
        )
        level = _mean(levels[::2])
        scatter = 1.25 * _mean([abs(value - level) for value in levels])
        level_error = scatter * math.sqrt(1.5 / len(levels))
        # The gait is not settled, which disturbs a turned sensor.
        if len(self._halves) < 2 * TRIAL_BEATS:
            level_error = self.ripple
        self._noise_count = min(self._noise_count + 1, NOISE_MEMORY)
        self._noise += (_mean(noises) - self._noise) / self._noise_count
        is_clear = middle > CLEAR_RATIO * self._noise
        return Judgement(self.ripple, error, half_beat, level, level_error, is_clear)

    def _judge(self, gait: Judgement) -> None:
        """Continue with the next phase after a measurement."""
        match self.phase:
            case Phase.LAUNCH:
                self._begin(Phase.BEFORE)
            case Phase.BEFORE:
                self._resume(gait)
            case Phase.TRIAL:
                self._trial = gait
                usual = self._reference.half_beat
                if abs(gait.half_beat - usual) < SAME_GAIT_TOLERANCE * usual:
                    self._look_beyond()
                else:
                    self._begin(Phase.AFTER)
            case Phase.AFTER:
                self._decide(gait)
            case Phase.WATCH:
                self._watch(gait)

    def _launch(self, lost: float) -> None:
        """Restart a lost gait, which had this ripple [N]."""
        self._lost = lost
        self._begin(Phase.LAUNCH)

    def _resume(self, gait: Judgement) -> None:
        """Continue with trials if the gait is back; if it stays lost, look for another one."""
        self._reference = gait
        self._clear_in_a_row = self._clear_in_a_row + 1 if gait.is_clear else 0
        if gait.ripple < LOST_RATIO * self._lost:
            if self._place != self._former:
                self._avoided.add(self._place)
                self._place, self._trials = self._former, []
                self._launch(self._lost)
                return
            self._restart_search()
        self._lost = 0.0
        self._try_next()

    def _restart_search(self) -> None:
        self._trials = list(NEIGHBOUR_STEPS)
        self._avoided.clear()

    def _decide(self, after: Judgement) -> None:
        """Take the tried rung, keep the current one, or repeat the trial."""
        before, self._reference = self._reference, after
        is_clear = self._trial.is_clear
        if after.ripple < LOST_RATIO * before.ripple and self._trial.ripple < before.ripple:
            self._avoided.add(self._place + self._trials.pop(0))
            self._launch(before.ripple)
            return
        self._moves.append(after.level - before.level)
        self._gains.append(compare_gaits(before, self._trial, after))
        gain, error = self._mean_gain()
        excess = gain - MIN_GAIN
        is_even = abs(excess) < MIN_STANDARD_ERRORS * error
        if is_clear and is_even and len(self._gains) < MAX_ROUNDS:
            self._begin(Phase.TRIAL)
            return
        step = self._trials.pop(0)
        if is_clear and excess > 0.0:
            if MIN_TRIAL_RATIO * (1.0 + gain) > 1.0:
                self._avoided.add(self._place)
            self._former = self._place
            self._place += step
            direction = 1 if step > 0 else -1
            # The rungs behind were worse; a skipped rung is unknown.
            skipped = [-2 * direction] if abs(step) > 2 else []
            self._trials = [2 * direction, 4 * direction, *skipped, 1, -1] if step % 2 == 0 else []
            self._begin(Phase.BEFORE)
        else:
            if self._trial.ripple < MIN_TRIAL_RATIO * after.ripple:
                self._avoided.add(self._place + step)
            self._try_next()

    def _mean_gain(self) -> tuple[float, float]:
        """Return the relative gain of the trial over all its rounds, and its standard error [1]."""
        rounds = len(self._gains)
        ripple, noise, level, level_noise = (
            sum(column) / rounds for column in zip(*self._gains, strict=True)
        )
        noise, level_noise = noise / rounds, level_noise / rounds
        ripple_now = self._reference.ripple
        drifts = [UNSTEADY_DRIFT_FRACTION * move / ripple_now for move in self._moves]
        # Drift as a fraction of the thrust; repetitions do not average it out.
        level_noise += 0.5 * _mean([drift**2 for drift in (*drifts, INITIAL_DRIFT)])
        share = level_noise / (level_noise + noise + RIPPLE_BIAS**2)  # weight of the ripple
        error = math.hypot(share * math.sqrt(noise), (1.0 - share) * math.sqrt(level_noise))
        return share * ripple + (1.0 - share) * level, error

    def _look_beyond(self) -> None:
        """Try the next rung instead of one that gives the current gait."""
        step = self._trials.pop(0)
        further = step + (2 if step > 0 else -2)
        if further in self._trials:
            self._trials.remove(further)
        if abs(further) <= MAX_STEP:
            self._trials.insert(0, further)
        self._try_next()

    def _try_next(self) -> None:
        """Begin the next trial; after the last one, watch."""
        while self._trials and not self._may_try(self._place + self._trials[0]):
            self._trials.pop(0)
        if not self._trials:
            self._known, self._watched = self._reference.ripple, 0.0
            was_clear, self.is_clear = self.is_clear, self._reference.is_clear
            if not self.is_clear:
                self._place = 2 * START_INDEX
            if was_clear > self.is_clear:
                log.warning("C auto stays at 0.6: the ripple of F_x does not rise above the noise")
        self._gains = []
        self._begin(Phase.TRIAL if self._trials else Phase.WATCH)

    def _may_try(self, place: int) -> bool:
        return 0 <= place <= 2 * (len(LADDER) - 1) and place not in self._avoided

    def _watch(self, gait: Judgement) -> None:
        """Restart the search if the fish has changed; try one neighbour from time to time."""
        self._reference = gait
        if gait.ripple < LOST_RATIO * self._known:
            self._launch(self._known)
        elif not self.is_clear and self._clear_in_a_row < MIN_CLEAR:
            self._start_sums()
        elif abs(gait.ripple - self._known) > max(
            MIN_CHANGE * self._known, MIN_CHANGE_STANDARD_ERRORS * gait.error
        ):
            self._restart_search()
            self._try_next()
        elif self._watched > RETRY_INTERVAL_S:
            self._trials = [NEIGHBOUR_STEPS[self._turn]]
            self._turn = (self._turn + 1) % len(NEIGHBOUR_STEPS)
            self._try_next()
        else:
            self._known += 0.2 * (gait.ripple - self._known)
            self._start_sums()


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values)


def _median(values: list[float]) -> float:
    """Return the median; `statistics` has both, but takes milliseconds to load."""
    middle = len(values) // 2
    values = sorted(values)
    return values[middle] if len(values) % 2 else 0.5 * (values[middle - 1] + values[middle])
