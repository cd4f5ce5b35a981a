"""Finds the C with which `swing` pushes most, by trying its neighbours there and back.

What is compared is the ripple of F_x. A fin that swings as α = A sin ωt gives
F_x = −Kαα̈ = ½KA²ω² (1 − cos 2ωt): the force ripples twice a beat, and by as much as its mean. The
mean drifts with the sensor and the ripple does not. It is taken from the two halves of a beat laid
upon each other, from reversal to reversal, so that what a turned sensor mixes in of F_y, which has
the other sign in the other half, is gone; and so is the sign of F_y.
"""

import math
from enum import Enum
from typing import NamedTuple


class Rung(NamedTuple):
    """When to reverse."""

    C: float
    """When the fin's speed falls to this share of its last maximum,"""
    lead: float = 0.0
    """or rather the speed that is foreseen so far ahead [s]."""


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
WORSE = 0.8
"""After one beat with a ripple below this share a trial ends."""
FASTER_RIPPLES = 0.15
"""Gaits of equal thrust ripple more the faster they are, by a power of their frequency: 0.35 is the
median of 80 pairs of gaits of 35 simulated fish, and less is safer for fish that hardly brake."""
SAME = 0.03
"""Half beats that differ by less than this share are the same gait; the next rung is tried."""
PATIENCE = 40.0
"""Once all neighbours are worse, so long until one of them is tried again [s]."""
CHANGED = 0.25
"""With a ripple that differs by this share from what it was, it is another fish."""
FURTHEST = 4
NEIGHBOURS = (1, -1, 2, -2)
"""Steps on the ladder that are tried, in this order."""


class Judgement(NamedTuple):
    """What the force says of some beats."""

    merit: float
    """The ripple, made comparable with that of other gaits."""
    half_beat: float
    """Mean [s]."""


class Phase(Enum):
    """Where the search is."""

    BEFORE = "before a trial"
    TRIAL = "a trial"
    AFTER = "after a trial"
    WATCH = "watching"


class CriterionSearch:
    """Chooses the rung, told of the force in each tick."""

    def __init__(self) -> None:
        self.ripple = 0.0
        """Of the latest beats [N]."""
        self._rung = BEGIN
        self._trials = list(NEIGHBOURS)
        self._turn = 0
        self._reference = self._trial = Judgement(0.0, 0.0)
        self._known = 0.0
        self._watched = 0.0
        self._side = 0.0
        self._forces: list[float] = []
        self._begin(Phase.BEFORE)

    @property
    def rung(self) -> Rung:
        """To be used now."""
        return LADDER[self._rung + (self._trials[0] if self.phase is Phase.TRIAL else 0)]

    def update(self, force: float, dt: float, side: float) -> None:
        """Take in a tick.

        force: mean F_x since the tick before [N]
        dt: since then [s]
        side: sign of the command since then
        """
        self._watched += dt
        if side != self._side:
            if self._forces:
                self._close_half(self._forces, dt * len(self._forces))
            self._side, self._forces = side, []
        self._forces.append(force)

    def _begin(self, phase: Phase) -> None:
        self.phase = phase
        self._skip = 2  # half beats in which the fin settles
        self._start_sums()

    def _start_sums(self) -> None:
        self._last: list[float] | None = None
        self._variances: list[float] = []
        self._lasted = 0.0

    def _close_half(self, forces: list[float], lasted: float) -> None:
        if self._skip:
            self._skip -= 1
            return
        self._lasted += lasted
        if self._last:
            self._variances.append(_variance(self._last, forces))
        self._last = forces
        if not self._variances:
            return
        gait = self._gait()
        hopeless = self.phase is Phase.TRIAL and gait.merit < WORSE * self._reference.merit
        if len(self._variances) >= 2 * BEATS - 1 or hopeless:
            self._judge(gait)

    def _gait(self) -> Judgement:
        """As the half beats since the phase began show it."""
        count = len(self._variances)
        mean = sum(self._variances) / count
        half_beat = self._lasted / (count + 1)
        self.ripple = math.sqrt(mean)
        return Judgement(self.ripple * half_beat**FASTER_RIPPLES, half_beat)

    def _judge(self, gait: Judgement) -> None:
        """Go on, knowing the gait of a whole phase."""
        match self.phase:
            case Phase.BEFORE:
                self._reference = gait
                self._try_next()
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

    def _decide(self, after: Judgement) -> None:
        """Take the rung that was tried, or stay."""
        step = self._trials.pop(0)
        usual = 0.5 * (self._reference.merit + after.merit)
        if self._trial.merit > (1.0 + CLEAR) * usual:
            self._rung += step
            ahead = 1 if step > 0 else -1
            # What lies behind was worse; what was jumped over is not known.
            self._trials = [ahead, 2 * ahead] + ([-ahead] if abs(step) > 1 else [])
            self._begin(Phase.BEFORE)
        else:
            self._reference = after
            self._try_next()

    def _look_beyond(self) -> None:
        """This rung gives the gait that is in use: try the next one instead."""
        step = self._trials.pop(0)
        further = step + (1 if step > 0 else -1)
        if further in self._trials:
            self._trials.remove(further)
        if abs(further) <= FURTHEST:
            self._trials.insert(0, further)
        self._try_next()

    def _try_next(self) -> None:
        """Begin a trial; watch where there is none left."""
        while self._trials and not 0 <= self._rung + self._trials[0] < len(LADDER):
            self._trials.pop(0)
        if not self._trials:
            self._known, self._watched = self._reference.merit, 0.0
        self._begin(Phase.TRIAL if self._trials else Phase.WATCH)

    def _watch(self, gait: Judgement) -> None:
        """Search anew where the fish is another one; now and then try one neighbour."""
        self._reference = gait
        if abs(gait.merit - self._known) > CHANGED * self._known:
            self._trials = list(NEIGHBOURS)
            self._try_next()
        elif self._watched > PATIENCE:
            self._trials = [NEIGHBOURS[self._turn]]
            self._turn = (self._turn + 1) % len(NEIGHBOURS)
            self._try_next()
        else:
            self._known += 0.2 * (gait.merit - self._known)
            self._start_sums()


def _variance(one: list[float], other: list[float]) -> float:
    """Of the mean of two half beats, tick by tick from their reversals [N²]."""
    both = [0.5 * (a + b) for a, b in zip(one, other, strict=False)]
    mean = sum(both) / len(both)
    return sum((force - mean) ** 2 for force in both) / len(both)
