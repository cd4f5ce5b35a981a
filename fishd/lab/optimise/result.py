"""Result of a search: its best parameters, and the thrust and power with them."""

import math
from collections.abc import Callable, Sequence

from fishd.core.calibration import ForceCalibration
from fishd.lab.error_budget import Thrust, thrust_fields
from fishd.lab.optimise.choice import Choice
from fishd.lab.optimise.search import Proposal
from fishd.lab.optimise.trials import Aim, Trial


class Optimum(Thrust, frozen=True, kw_only=True):
    """Result of a search; the fields are those of the JSON output."""

    controller: str
    parameters: dict[str, float]
    parameters_ci95_low: dict[str, float]
    """Lower end of the 95 % interval of each parameter."""
    parameters_ci95_high: dict[str, float]
    """Upper end of that interval."""
    is_measured: bool
    """Whether thrust and power are a measurement of these parameters, not a prediction."""
    improvement: float
    """Expected improvement by another trial, as a fraction of the objective."""
    trials: int
    swim_ticks: int
    tank_time: float
    """Tank time, rests included [s]."""
    objective: str = "thrust"
    target: float | None = None
    """Thrust to reach [N]; null without --target-thrust."""
    choice_time: float | None = None
    """Time that a real fish waited for the choice of candidates [s]."""
    true_thrust: float | None = None
    """True thrust of a simulated fish at the best parameters [N]."""
    relative_thrust: float | None = None
    """`true_thrust` divided by the thrust of the best square wave."""
    true_power: float | None = None
    """True power of a simulated servo at the best parameters [W]."""


def make_optimum(
    controller: str,
    trials: Sequence[Trial],
    choice: Choice,
    proposal: Proposal,
    aim: Aim,
    calibration: ForceCalibration,
) -> Optimum:
    """Return the result of a search.

    Without a measurement of the best candidate, for which there was no time, thrust and power are
    those that are expected there.

    calibration: that of the force sensor
    """
    final, search = choice.final, choice.search
    parameters = final.parameters if final else proposal.parameters

    def value_of(name: str) -> tuple[float, float]:
        if final:
            return getattr(final, name), getattr(final, f"{name}_ci95")
        known = [(t.parameters, getattr(t, name), getattr(t, f"{name}_ci95")) for t in trials]
        return search.with_observations(known).predict(parameters)

    has_power = all(math.isfinite(trial.power) for trial in trials)
    rotations = [trial.rotation for trial in trials if trial.rotation]
    return Optimum(
        controller=controller,
        is_measured=final is not None,
        parameters=parameters,
        parameters_ci95_low=_combine_ends(min, parameters, proposal.parameters_ci95_low),
        parameters_ci95_high=_combine_ends(max, parameters, proposal.parameters_ci95_high),
        improvement=proposal.improvement,
        trials=len(trials),
        objective=aim.objective if aim.target is None else "least-power",
        target=aim.target,
        swim_ticks=trials[-1].swim_ticks,
        tank_time=trials[-1].tank_time,
        **thrust_fields(
            calibration,
            *value_of("thrust"),
            *(value_of("power") if has_power else ()),
            rotation=sum(rotations) / len(rotations) if rotations else 0.0,
        ),
    )


def _combine_ends(
    choose: Callable[[float, float], float], best: dict[str, float], ends: dict[str, float]
) -> dict[str, float]:
    """Return the ends of intervals, moved so that they include the best values."""
    return {name: choose(best[name], end) for name, end in ends.items()}
