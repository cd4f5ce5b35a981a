"""The output of a training for the user: its lines, and a progress bar."""

from typing import TYPE_CHECKING

from fishd.core.experiments import CurvePoint, Estimate
from fishd.lab.experiment import Progress

if TYPE_CHECKING:
    from fishd.learning.env.evaluation import Evaluation

NOT_COUNTED = " without evaluations"
"""Note on the tank time of a simulated training, whose evaluations swim a separate fish."""


class Display:
    """A receiver of the progress of a training; this base class shows nothing."""

    def begin(self, steps: int, target: int, text: str) -> None:
        """Handle the start, or the resumption after `steps`; text: one line about the training."""

    def imitated(self, number: int, rounds: int, right: float) -> None:
        """Handle the end of a round of imitation; right: weighted share of right sides."""

    def step(self, tank_time: float) -> None:
        """Handle the end of a control step; tank_time: [s]."""

    def explored(self, thrust: float, relative_thrust: float, frequency: float) -> None:
        """Handle the end of a rollout; thrust: mean [N], frequency: mean [Hz]."""

    def evaluated(self, evaluation: "Evaluation") -> None:
        """Handle the end of an evaluation."""


class ShownDisplay(Display):
    """A display with a line per evaluation, and a bar with thrust, frequency and tank time."""

    def __init__(self, show: Progress) -> None:
        self._show = show
        self._steps = 0
        self._figures = ""
        self._was_evaluated = False
        self._best = 0.0
        """Highest merit shown until now."""

    def begin(self, steps: int, target: int, text: str) -> None:
        """Print `text`."""
        self._steps = steps
        self._show.done(text, steps)

    def imitated(self, number: int, rounds: int, right: float) -> None:
        """Print one line, but only for about ten of many rounds."""
        if number == rounds or number % max(1, rounds // 10) == 0:
            self._show.done(format_imitation(number, rounds, right), self._steps)

    def step(self, tank_time: float) -> None:
        """Advance the bar by one step."""
        self._steps += 1
        self._show.at(self._steps, f"{self._figures}  tank {format_minutes(tank_time)}")

    def explored(self, thrust: float, relative_thrust: float, frequency: float) -> None:
        """Show how the fish swam with exploration, until the first evaluation."""
        if not self._was_evaluated:
            self._figures = format_figures(thrust, relative_thrust, frequency)

    def evaluated(self, evaluation: "Evaluation") -> None:
        """Print one line.

        In simulation the policy is called the best only if the figure shown is higher, too.
        """
        self._was_evaluated = True
        self._figures = format_summary(evaluation)
        merit = round(evaluation.merit, 3)
        better = evaluation.best and (evaluation.thrust_ci95 is not None or merit > self._best)
        self._best = merit if better else self._best
        line = format_evaluation(evaluation) + (", the best so far" if better else "")
        thrust, ci95 = evaluation.thrust, evaluation.thrust_ci95
        self._show.done(line, self._steps, CurvePoint(evaluation.steps, thrust, ci95, "steps"))
        if better:
            self._show.estimate(list_estimates(evaluation))


def list_estimates(best: "Evaluation") -> list[Estimate]:
    """Return the thrust of the best policy, and its share of the best square wave."""
    thrust, half = best.thrust, best.thrust_ci95
    low, high = (None, None) if half is None else (thrust - half, thrust + half)
    share = Estimate("of the best square wave", 100.0 * best.relative_thrust, unit="%")
    return [Estimate("thrust of the best policy", thrust, low, high, "N"), share]


def format_imitation(number: int, rounds: int, right: float) -> str:
    """Format a round of imitation: `imitation 3 of 8: 92.1% right`."""
    return f"imitation {number} of {rounds}: {right:.1%} right"


def format_evaluation(evaluation: "Evaluation") -> str:
    """Format an evaluation in one line."""
    when = f"{evaluation.steps:7d} steps, {format_minutes(evaluation.tank_time):>8} in the tank"
    if evaluation.swim_time is None:
        when += NOT_COUNTED
    if evaluation.swim_time is not None and evaluation.policy != evaluation.steps:
        when += f", policy of {evaluation.policy} steps"
    others = (
        f", worst of other fish {evaluation.lowest_relative_thrust:.1%}"
        if evaluation.lowest_relative_thrust is not None
        else ""
    )
    return f"{when}: {format_summary(evaluation)}{others}"


def format_summary(evaluation: "Evaluation") -> str:
    """Format the figures of an evaluation, or state that the policy does not swim."""
    if evaluation.is_stalled:
        return "stalled: it does not swim"
    error = evaluation.thrust_ci95
    return format_figures(
        evaluation.thrust, evaluation.relative_thrust, evaluation.frequency, error
    )


def format_figures(
    thrust: float, relative_thrust: float, frequency: float, error: float | None = None
) -> str:
    """Format figures: `25.1 mN  97.8%  1.67 Hz`, or `25.1 ± 0.3 mN  97.8%  1.67 Hz`."""
    known = "" if error is None else f" ± {error * 1e3:.1f}"
    return f"{thrust * 1e3:.1f}{known} mN  {relative_thrust:.1%}  {frequency:.2f} Hz"


def format_minutes(seconds: float) -> str:
    """Format a time: `6:40`, or `1:06:40`."""
    whole = round(seconds)
    hours, rest = divmod(whole, 3600)
    text = f"{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"
    return f"{hours}:{text}" if hours else text
