"""Aim of a search: most thrust, most thrust per watt, or a given thrust at the least power."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

from fishd.core.errors import ParameterError
from fishd.lab.optimise.least_power import LeastPower
from fishd.lab.optimise.search import Range, Search
from fishd.lab.optimise.trials import Trial
from fishd.lab.statistics import per_watt


class Aim(NamedTuple):
    """Objective or target of a search."""

    objective: Literal["thrust", "thrust-per-watt"] = "thrust"
    """Quantity to maximise; ignored if there is a target."""
    target: float | None = None
    """Thrust to reach at the least power [N]."""

    def make_search(self, ranges: Sequence[Range], seed: int) -> Search | LeastPower:
        """Return a new search with this aim; raises `ParameterError`."""
        if self.target is not None:
            return LeastPower(ranges, self.target, seed)
        return Search(ranges, seed)

    def observe(self, search: Search | LeastPower, trial: Trial) -> None:
        """Add a measured candidate to a search, with the quantity of this aim.

        Raises `ParameterError` if the aim needs the power, and the power is unknown.
        """
        thrust = trial.thrust, trial.error
        if self.objective == "thrust" and self.target is None:
            assert isinstance(search, Search)
            search.observe(trial.parameters, *thrust)
            return
        if not (math.isfinite(trial.power) and trial.power > 0.0):
            raise ParameterError(
                "this needs the power of the servo, and the fish has no power meter that can be "
                "read: set power_meter in its configuration, see docs/how-to/power.md"
            )
        if isinstance(search, LeastPower):
            search.observe(trial.parameters, thrust, (trial.power, trial.power_error))
            return
        value, error = per_watt(*thrust, trial.power, trial.power_error)
        assert value is not None
        assert error is not None
        search.observe(trial.parameters, value, error)
