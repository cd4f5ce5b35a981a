"""Finds the C with which `swing` pushes most, by trying its neighbours there and back.

A fin that swings as α = A sin ωt gives F_x = −Kαα̈ = ½KA²ω² (1 − cos 2ωt): the force ripples twice a
beat, and by as much as its mean. The mean drifts with the sensor; the ripple does not. It is taken
from the two halves of the beat, one laid upon the other, so that whatever of F_y a turned sensor
mixes in, with the other sign in the other half, is gone. Each trial compares a neighbour with the C
in use before and after it, so that what changes slowly counts for neither.
"""

import math
from enum import Enum

LADDER = ((0.0, 0), (0.2, 0), (0.4, 0), (0.6, 0), (0.75, 0), (0.9, 0), (0.98, 0), (0.9, 1), (0.9, 2), (0.9, 3))
"""Values of C that are tried; beyond 0.6 a fish with a late servo gains."""
BEGIN = 3
"""The first one in use, 0.6."""
BEATS = 3
"""Whole beats that each value is judged by, after one to settle."""
CLEAR = 0.01
"""A neighbour is taken where it is better by this share."""
PATIENCE = 20.0
"""Once both neighbours are worse, so long until the next trial [s]."""
CHANGED = 0.25
"""The fish is another one where the C in use suddenly gives so much more or less, as a share."""
NEIGHBOURS = (1, -1, 2, -2)
WORSE = 0.8
_BINS = 12


class Phase(Enum):
    """Where a search is."""

    BEFORE = "before"
    TRIAL = "trial"
    AFTER = "after"
    WATCH = "watch"


class Ripple:
    def __init__(self):
        self.last=None; self.total=0.0; self.count=0
    def add(self, side, forces):
        if self.last:
            x,y=self.last,forces
            if len(x)!=len(y): y=_fit(y,len(x))
            both=[.5*(p+q) for p,q in zip(x,y)]
            m=sum(both)/len(both)
            self.total+=sum((v-m)**2 for v in both)/len(both); self.count+=1
        self.last=list(forces)
    def size(self):
        return math.sqrt(self.total/self.count) if self.count else 0.0

def _fit(y,n):
    m=len(y); out=[]
    for k in range(n):
        place=min(max((k+.5)/n*m-.5,0.),m-1.); i=min(int(place),m-2) if m>1 else 0
        sh=place-i; out.append((1-sh)*y[i]+sh*y[min(i+1,m-1)])
    return out


class CriterionSearch:
    """Chooses C, told of each tick."""

    def __init__(self) -> None:
        self._rung = BEGIN
        self._trials = list(NEIGHBOURS)
        self._before = self._trial = self._known = 0.0
        self._lengths = {Phase.BEFORE: 0.0, Phase.TRIAL: 0.0}
        self._watched = 0.0
        self._turn = 0
        self._forces: list[float] = []
        self._side = 0
        self._begin(Phase.BEFORE)

    @property
    def C(self):
        """To be used now."""
        return LADDER[self._rung + (self._trials[0] if self.phase is Phase.TRIAL else 0)]

    def _begin(self, phase: Phase) -> None:
        self.phase = phase
        self._ripple = Ripple()
        self._halves = -2  # of which one beat is to settle
        self._ticks = 0

    def update(self, force: float, dt: float, side: int) -> None:
        self._watched += dt
        if side != self._side:
            if self._forces and self._side:
                self._half_beat(self._side, self._forces)
            self._side, self._forces = side, []
        self._forces.append(force)

    def _half_beat(self, side: int, forces: list[float]) -> None:
        self._halves += 1
        if self._halves <= 0:
            return
        self._ripple.add(side, forces)
        self._ticks += len(forces)
        size = self._ripple.size()
        bad = self.phase is Phase.TRIAL and self._halves >= 2 and size < WORSE * self._before
        if self._halves < 2 * BEATS and not bad:
            return
        length = self._ticks / self._halves
        if self.phase is Phase.BEFORE:
            self._before, self._length = size, length
            self._next()
        elif self.phase is Phase.TRIAL:
            self._trial = size
            if abs(length - self._length) < 0.03 * self._length:  # the same gait
                self._skip()
            else:
                self._begin(Phase.AFTER)
        elif self.phase is Phase.AFTER:
            self._judge(size)
        else:
            self._watch(size)

    def _skip(self):
        """the same gait: go on with the one beyond"""
        step = self._trials.pop(0)
        further = step + (1 if step > 0 else -1)
        if further not in self._trials and abs(further) <= 4:
            self._trials.insert(0, further)
        self._next()

    def _next(self) -> None:
        while self._trials and not 0 <= self._rung + self._trials[0] < len(LADDER):
            self._trials.pop(0)
        if self._trials:
            self._begin(Phase.TRIAL)
        else:
            self._known, self._watched = self._before, 0.0
            self._begin(Phase.WATCH)

    def _judge(self, after: float) -> None:
        if self._trial > (1.0 + CLEAR) * 0.5 * (self._before + after):
            step = self._trials[0]
            self._rung += step
            ahead = 1 if step > 0 else -1
            self._trials = [ahead, 2 * ahead] + ([-ahead] if abs(step) > 1 else [])
            self._begin(Phase.BEFORE)
            return
        self._before = after
        self._trials.pop(0)
        self._next()

    def _watch(self, size: float) -> None:
        self._before = size
        if abs(size - self._known) > CHANGED * self._known:
            self._trials = list(NEIGHBOURS)
            self._next()
        elif self._watched > PATIENCE:
            self._turn = (self._turn + 1) % len(NEIGHBOURS)
            self._trials = [NEIGHBOURS[self._turn]]
            self._next()
        else:
            self._known += 0.2 * (size - self._known)
            self._begin(Phase.WATCH)
            self._halves = 0
