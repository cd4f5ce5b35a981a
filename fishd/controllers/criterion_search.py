"""Finds the C with which `swing` pushes most, by trying its neighbours there and back.

Two signs of the thrust are compared, the ripple and the mean of F_x. A fin that swings as
α = A sin ωt gives F_x = −Kαα̈ = ½KA²ω² (1 − cos 2ωt): the force ripples twice a beat, and by as much
as its mean. The ripple does not drift with the sensor, but other shapes of the beat have a ripple
that is a few percent larger or smaller for the same thrust. The mean is the thrust itself, and
drifts. The difference of a trial from the gait before and after it is free of a steady drift, and
how much the zero drifts is seen from before a trial to after it. So each counts by how well it is
known: on a rig that hardly drifts the mean decides, on another one the ripple.

What a turned sensor mixes in of F_y is taken off first, so the sign of F_y does not matter.
"""

import math
from collections import deque
from enum import Enum
from typing import NamedTuple

Forces = tuple[float, float]
"""F_x and F_y [N]."""


class Rung(NamedTuple):
    """When to reverse."""

    C: float
    """When the fin's speed falls to this share of its last maximum,"""
    lead: float = 0.0
    """or rather the speed that is predicted so far ahead [s]."""


LADDER = (
    *(Rung(C) for C in (0.0, 0.2, 0.4, 0.6, 0.75, 0.9, 0.98)),
    *(Rung(0.95, lead) for lead in (0.05, 0.1, 0.2, 0.4)),
)
"""From late to early reversals. A servo that is late, or a fin that the water brakes much, needs
them before the fin is at its fastest."""
BEGIN = LADDER.index(Rung(0.6))
BEATS = 3
"""Whole beats by which a rung is judged, after one in which the fin settles."""
CLEAR = 0.01
"""A rung is taken where its ripple is larger by this share than before and after it."""
RIPPLE_BIAS = 0.04
"""Standard deviation of the ripple's gain from the thrust's, as gaits differ in shape [1]."""
UNSTEADY = 0.25
"""Share of the move of the zero, from before a trial to after it, that is taken for unsteady: by so
much the zero within the trial may differ from the mean of the two [1]."""
MOVES = 8
"""Number of latest trials whose moves are remembered."""
DRIFT_AT_FIRST = 0.03
"""One more such difference, for the first trials: as a share of the ripple [1]."""
SURE = 1.0
"""A trial is repeated while its gain is known no better than within so many standard errors,"""
ROUNDS = 3
"""but no more often than this."""
WORSE = 0.8
"""After one beat with a ripple below this share a trial ends."""
FALLEN = 0.5
"""Below this share of its ripple a gait is lost: the tail only trembles."""
LAUNCH = 4
"""Half beats with the latest of all reversals, by which a lost gait is begun again."""
SAME = 0.03
"""Half beats that differ by less than this share are the same gait; the next rung is tried."""
PATIENCE = 40.0
"""Once all neighbours are worse, so long until one of them is tried again [s]."""
CHANGED = 0.25
"""With a ripple that differs by this share from what it was, it is another fish,"""
CERTAIN = 3.0
"""if it differs by so many standard errors, too."""
FURTHEST = 8
"""Half steps on the ladder that are looked beyond at most."""
NEIGHBOURS = (2, -2, 4, -4, 1, -1)
"""Half steps that are tried, in this order. Half way between two rungs, one side goes by the one
and the other side by the other: where a half beat has few ticks, the best may lie between."""


class Judgement(NamedTuple):
    """What the force says of some beats."""

    ripple: float
    """Of F_x, rms [N]."""
    error: float
    """Its standard error [N]."""
    half_beat: float
    """Mean [s]."""
    level: float
    """Mean of F_x: the thrust, and the zero of the sensor [N]."""
    level_error: float
    """Standard error of `level`, drift not counted [N]."""


class Gain(NamedTuple):
    """Relative gain of a trial over the mean of the gaits before and after it."""

    ripple: float
    """By the ripple [1]."""
    ripple_variance: float
    level: float
    """By the mean of F_x [1]."""
    level_variance: float


def compare_gaits(before: Judgement, trial: Judgement, after: Judgement) -> Gain:
    """Return the gain of a trial; the ripple of a sine is its thrust over √2, which is the unit."""
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
    """Where the search is."""

    BEFORE = "before a trial"
    TRIAL = "a trial"
    AFTER = "after a trial"
    WATCH = "watching"
    LAUNCH = "beginning a lost gait again"


class CriterionSearch:
    """Chooses the rung from the force of each tick."""

    def __init__(self) -> None:
        from fishd.controllers.ripple import ripples  # with numpy, which fishctl does without

        self._ripples = ripples
        self.ripple = 0.0
        """Of the latest beats [N]."""
        self._place = self._former = 2 * BEGIN  # on the ladder, in half steps; and the last one
        self._avoided: set[int] = set()  # where a gait was lost, or is much worse
        self._lost = 0.0  # ripple that a lost gait had
        self._trials = list(NEIGHBOURS)
        self._turn = 0
        self._reference = self._trial = Judgement(0.0, 0.0, 0.0, 0.0, 0.0)
        self._gains: list[Gain] = []  # of this trial, in each round
        self._moves: deque[float] = deque(maxlen=MOVES)  # of the zero, within a trial [N]
        self._known = 0.0
        self._watched = 0.0
        self._side = 0.0
        self._forces: list[Forces] = []
        self._begin(Phase.BEFORE)

    @property
    def rung(self) -> Rung:
        """To be used now."""
        place = self._in_use
        return LADDER[(place + 1) // 2 if self._side > 0.0 else place // 2]

    @property
    def halfway(self) -> bool:
        """Do the two sides go by two rungs?"""
        return self._in_use % 2 == 1

    @property
    def _in_use(self) -> int:
        """Where on the ladder, in half steps."""
        if self.phase is Phase.LAUNCH:
            return 0
        return self._place + (self._trials[0] if self.phase is Phase.TRIAL else 0)

    def update(self, fx: float, fy: float, dt: float, side: float) -> None:
        """Take in a tick.

        fx, fy: mean forces since the tick before [N]
        dt: since then [s]
        side: sign of the command since then
        """
        self._watched += dt
        if side != self._side:
            if self._forces:
                self._close_half(self._forces, dt * len(self._forces))
            self._side, self._forces = side, []
        self._forces.append((fx, fy))

    def _begin(self, phase: Phase) -> None:
        self.phase = phase
        self._skip = 2  # half beats in which the fin settles
        self._start_sums()

    def _start_sums(self) -> None:
        self._halves: list[list[Forces]] = []
        self._lasted = 0.0

    def _close_half(self, forces: list[Forces], lasted: float) -> None:
        if self._skip:
            self._skip -= 1
            return
        self._lasted += lasted
        self._halves.append(forces)
        if len(self._halves) < 2:
            return
        gait = self._gait()
        hopeless = self.phase is Phase.TRIAL and gait.ripple < WORSE * self._reference.ripple
        wanted = LAUNCH if self.phase is Phase.LAUNCH else 2 * BEATS
        if len(self._halves) >= wanted or hopeless:
            self._judge(gait)

    def _gait(self) -> Judgement:
        """As the half beats since the phase began show it."""
        squares, levels = self._ripples(self._halves)
        middle = _median(squares)
        half_beat = self._lasted / len(self._halves)
        self.ripple = math.sqrt(middle)
        scatter = 1.25 * _mean([abs(each - middle) for each in squares])
        # Of the root. Each half beat is in two of them, so they count for two thirds; and a median
        # is off by a fourth more than a mean.
        error = (
            0.5 * 1.25 * scatter * math.sqrt(1.5 / len(squares)) / self.ripple if middle else 0.0
        )
        level = _mean(levels[::2])
        scatter = 1.25 * _mean([abs(each - level) for each in levels])
        level_error = scatter * math.sqrt(1.5 / len(levels))
        if len(self._halves) < 2 * BEATS:  # the gait is not settled, and a turned sensor shows it
            level_error = self.ripple
        return Judgement(self.ripple, error, half_beat, level, level_error)

    def _judge(self, gait: Judgement) -> None:
        """Go on, knowing the gait of a whole phase."""
        match self.phase:
            case Phase.LAUNCH:
                self._begin(Phase.BEFORE)
            case Phase.BEFORE:
                self._resume(gait)
            case Phase.TRIAL:
                self._trial = gait
                usual = self._reference.half_beat
                if abs(gait.half_beat - usual) < SAME * usual:
                    self._look_beyond()
                else:
                    self._begin(Phase.AFTER)
            case Phase.AFTER:
                self._decide(gait)
            case Phase.WATCH:
                self._watch(gait)

    def _launch(self, lost: float) -> None:
        """Begin a gait again that had this ripple [N]."""
        self._lost = lost
        self._begin(Phase.LAUNCH)

    def _resume(self, gait: Judgement) -> None:
        """Go on with trials where the gait is there; where it stays lost, look for another one."""
        self._reference = gait
        if gait.ripple < FALLEN * self._lost:
            if self._place != self._former:
                self._avoided.add(self._place)
                self._place, self._trials = self._former, []
                self._launch(self._lost)
                return
            self._search_anew()
        self._lost = 0.0
        self._try_next()

    def _search_anew(self) -> None:
        self._trials = list(NEIGHBOURS)
        self._avoided.clear()

    def _decide(self, after: Judgement) -> None:
        """Take the rung that was tried, or stay; or try it once more."""
        before, self._reference = self._reference, after
        if after.ripple < FALLEN * before.ripple and self._trial.ripple < before.ripple:
            self._avoided.add(self._place + self._trials.pop(0))
            self._launch(before.ripple)
            return
        self._moves.append(after.level - before.level)
        self._gains.append(compare_gaits(before, self._trial, after))
        gain, error = self._mean_gain()
        above = gain - CLEAR
        if abs(above) < SURE * error and len(self._gains) < ROUNDS:
            self._begin(Phase.TRIAL)
            return
        step = self._trials.pop(0)
        if above > 0.0:
            if WORSE * (1.0 + gain) > 1.0:
                self._avoided.add(self._place)
            self._former = self._place
            self._place += step
            ahead = 1 if step > 0 else -1
            # What lies behind was worse; what was jumped over is not known.
            behind = [-2 * ahead] if abs(step) > 2 else []
            self._trials = [2 * ahead, 4 * ahead, *behind, 1, -1] if step % 2 == 0 else []
            self._begin(Phase.BEFORE)
        else:
            if self._trial.ripple < WORSE * after.ripple:
                self._avoided.add(self._place + step)
            self._try_next()

    def _mean_gain(self) -> tuple[float, float]:
        """Return the relative gain of the trial by all its rounds, and its standard error [1]."""
        rounds = len(self._gains)
        ripple, noise, level, level_noise = (
            sum(column) / rounds for column in zip(*self._gains, strict=True)
        )
        noise, level_noise = noise / rounds, level_noise / rounds
        ripple_now = self._reference.ripple
        drifts = [UNSTEADY * move / ripple_now for move in self._moves]
        # As a share of the thrust. Rounds do not average it.
        level_noise += 0.5 * _mean([drift**2 for drift in (*drifts, DRIFT_AT_FIRST)])
        share = level_noise / (level_noise + noise + RIPPLE_BIAS**2)  # by which the ripple counts
        error = math.hypot(share * math.sqrt(noise), (1.0 - share) * math.sqrt(level_noise))
        return share * ripple + (1.0 - share) * level, error

    def _look_beyond(self) -> None:
        """This rung gives the gait that is in use: try the next one instead."""
        step = self._trials.pop(0)
        further = step + (2 if step > 0 else -2)
        if further in self._trials:
            self._trials.remove(further)
        if abs(further) <= FURTHEST:
            self._trials.insert(0, further)
        self._try_next()

    def _try_next(self) -> None:
        """Begin the next trial; once all are made, watch."""
        while self._trials and not self._may_try(self._place + self._trials[0]):
            self._trials.pop(0)
        if not self._trials:
            self._known, self._watched = self._reference.ripple, 0.0
        self._gains = []
        self._begin(Phase.TRIAL if self._trials else Phase.WATCH)

    def _may_try(self, place: int) -> bool:
        return 0 <= place <= 2 * (len(LADDER) - 1) and place not in self._avoided

    def _watch(self, gait: Judgement) -> None:
        """Search anew where the fish is another one; now and then try one neighbour."""
        self._reference = gait
        if gait.ripple < FALLEN * self._known:
            self._launch(self._known)
        elif abs(gait.ripple - self._known) > max(CHANGED * self._known, CERTAIN * gait.error):
            self._search_anew()
            self._try_next()
        elif self._watched > PATIENCE:
            self._trials = [NEIGHBOURS[self._turn]]
            self._turn = (self._turn + 1) % len(NEIGHBOURS)
            self._try_next()
        else:
            self._known += 0.2 * (gait.ripple - self._known)
            self._start_sums()


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values)


def _median(values: list[float]) -> float:
    """Return the median; `statistics`, which has both, takes milliseconds to load."""
    middle = len(values) // 2
    values = sorted(values)
    return values[middle] if len(values) % 2 else 0.5 * (values[middle - 1] + values[middle])
