"""Choice of candidates: those of a search, then the best one, whose measurement is the result."""

import time
from collections.abc import Mapping
from typing import Any

from fishd.core.swim_plan import MEAN_REST_S
from fishd.lab.optimise.least_power import LeastPower
from fishd.lab.optimise.search import Proposal, Search
from fishd.lab.optimise.trials import Aim, Candidate, Trial

MAX_FINALS = 3
"""Largest number of measurements of a best candidate, if each moves the best to another place."""
MAX_SHIFT = 0.05
"""Largest shift of the best, as a share of a range, for which its measurement is the result."""
NEIGHBOUR_SHARE = 0.12
"""Distance from the best, as a share of a range, at which both sides must be measured."""


class Choice:
    """Candidates of a search, for `measure_trials`."""

    def __init__(
        self,
        search: Search | LeastPower,
        aim: Aim,
        fixed: Mapping[str, Any],
        min_gain: float,
    ) -> None:
        """
        fixed: parameters that are not searched
        min_gain: expected gain of another candidate, as a fraction, below which the search ends
        """
        self.search = search
        self._aim, self._fixed, self._min_gain = aim, fixed, min_gain
        self._finals = 0
        self._tried: set[float] = set()
        """Tried values of the parameter, if there is only one."""
        self._beat = 0.0
        self.final: Trial | None = None
        """Latest measurement of a best candidate."""
        self.waited = 0.0
        """Time that choices have taken, in which the fish waits [s]."""

    def add(self, trial: Trial) -> None:
        """Add a measured candidate."""
        self._aim.observe(self.search, trial)
        self._beat = trial.beat
        if len(self.search.ranges) == 1:
            self._tried.update(trial.parameters.values())
        if trial.is_final:
            self.final = trial
            self._finals += 1

    def is_done(self, proposal: Proposal) -> bool:
        """Return whether another candidate is expected to give too little more."""
        return self.search.is_warm and proposal.improvement <= self._min_gain

    def next(self, time_left: float) -> Candidate | None:
        """Return the next candidate; None at the end of the search, or of the time."""
        begin = time.monotonic()
        try:
            return self._choose(time_left)
        finally:
            self.waited += time.monotonic() - begin

    def _choose(self, time_left: float) -> Candidate | None:
        if not self.search.is_filled:
            return Candidate(self.search.suggest())
        proposal = self.search.propose()
        final = Candidate(proposal.parameters, is_final=True)
        is_final_known = self.final is not None and self._is_near(self.final.parameters, proposal)
        neighbour = self._find_untried_neighbour(proposal)
        if self.is_done(proposal) and neighbour is None:
            return None if is_final_known or self._finals >= MAX_FINALS else final
        candidate = neighbour if self.is_done(proposal) else None
        candidate = candidate or Candidate(self.search.suggest())
        if self._time(candidate) + self._time(final) > time_left:
            return None if is_final_known else final
        return candidate

    def _find_untried_neighbour(self, proposal: Proposal) -> Candidate | None:
        """Return a value beside the best one where nothing was measured; None if there is none.

        Between two measured values a curve may be higher, or fall, by more than is expected of a
        smooth one: the half beats of a controller are whole ticks. Only one parameter is looked at.
        """
        if len(self.search.ranges) > 1:
            return None
        searched = self.search.ranges[0]
        best = proposal.parameters[searched.name]
        if searched.values:
            place = searched.values.index(best)
            near = searched.values[max(0, place - 1) : place + 2]
            new = [value for value in near if value not in self._tried]
        else:
            share = searched.share(best)
            sides = (min(1.0, share + NEIGHBOUR_SHARE), max(0.0, share - NEIGHBOUR_SHARE))
            tried = [searched.share(value) for value in self._tried]
            new = [
                searched.value(side)
                for side in sides
                if all(abs(side - other) > 0.5 * NEIGHBOUR_SHARE for other in tried)
            ]
        return Candidate({searched.name: new[0]}) if new else None

    def _time(self, candidate: Candidate) -> float:
        """Return the tank time of a candidate, rests included [s]."""
        _, length, swims = candidate.durations(self._fixed, self._beat)
        return swims * (length + MEAN_REST_S)

    def _is_near(self, parameters: Mapping[str, float], proposal: Proposal) -> bool:
        """Return whether the best is still where it was measured."""
        return all(
            abs(
                searched.share(parameters[searched.name])
                - searched.share(proposal.parameters[searched.name])
            )
            <= MAX_SHIFT
            for searched in self.search.ranges
        )
