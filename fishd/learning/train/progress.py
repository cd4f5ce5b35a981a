"""What a person sees of a training: a live bar on a terminal, else a line for each evaluation."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from rich.progress import TaskID

    from fishd.learning.env.evaluation import Evaluation


NOT_COUNTED = " without evaluations"
"""Addition to the tank time of a simulated training, whose evaluations swim a fish of their own."""


class Display:
    """Is told how a training goes on; this one shows nothing."""

    def begin(self, steps: int, target: int, text: str) -> None:
        """It begins, or goes on, after so many steps; text: what and where, one line."""

    def imitated(self, number: int, rounds: int, right: float) -> None:
        """A round of imitation is done; right: share of right sides, weighted."""

    def step(self, tank_time: float) -> None:
        """One more control step is done; tank_time: [s]."""

    def explored(self, thrust: float, relative_thrust: float, frequency: float) -> None:
        """A rollout is done, with these means [N], [Hz]."""

    def evaluated(self, evaluation: "Evaluation") -> None:
        """An evaluation is done."""


class LineDisplay(Display):
    """A line for each evaluation, for logs and pipes."""

    _best = 0.0
    """The highest merit so far, as shown."""

    def begin(self, steps: int, target: int, text: str) -> None:
        """Print where the run is."""
        click.echo(text)

    def imitated(self, number: int, rounds: int, right: float) -> None:
        """Print one line."""
        click.echo(imitation(number, rounds, right))

    def evaluated(self, evaluation: "Evaluation") -> None:
        """Print one line.

        In simulation it is called the best only where the figure shown is higher, too.
        """
        merit = round(evaluation.merit, 3)
        better = evaluation.best and (evaluation.error is not None or merit > self._best)
        self._best = merit if better else self._best
        click.echo(described(evaluation) + (", the best so far" if better else ""))


class BarDisplay(Display):
    """A progress bar with thrust, relative thrust, frequency, tank time and time left."""

    def __init__(self) -> None:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
        )

        self._progress = Progress(
            MofNCompleteColumn(),
            TextColumn("steps"),
            BarColumn(bar_width=20),
            TextColumn("{task.fields[figures]}"),
            TextColumn("tank {task.fields[tank]}"),
            TimeRemainingColumn(compact=True),
            TextColumn("left"),
        )
        self._task: TaskID
        self._was_evaluated = False

    def begin(self, steps: int, target: int, text: str) -> None:
        """Show the bar below a line."""
        self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)
        self._task = self._progress.add_task(
            "", completed=steps, total=target, figures="", tank="0:00"
        )
        self._progress.start()

    def imitated(self, number: int, rounds: int, right: float) -> None:
        """Show it in place of how it swims."""
        self._progress.update(self._task, figures=imitation(number, rounds, right))

    def step(self, tank_time: float) -> None:
        """Advance by one."""
        self._progress.update(self._task, advance=1, tank=minutes(tank_time))

    def explored(self, thrust: float, relative_thrust: float, frequency: float) -> None:
        """Show how the fish swam with exploration, until the first evaluation."""
        if not self._was_evaluated:
            self._progress.update(self._task, figures=figures(thrust, relative_thrust, frequency))

    def evaluated(self, evaluation: "Evaluation") -> None:
        """Show how it swims without exploration."""
        self._was_evaluated = True
        self._progress.update(self._task, figures=summary(evaluation))

    def stop(self) -> None:
        """Leave the terminal as it is."""
        self._progress.stop()


@contextmanager
def on_terminal() -> Iterator[Display]:
    """A bar where standard output is a terminal, else lines."""
    if not sys.stdout.isatty():
        yield LineDisplay()
        return
    bar = BarDisplay()
    try:
        yield bar
    finally:
        bar.stop()


def imitation(number: int, rounds: int, right: float) -> str:
    """`imitation 3 of 8: 92.1% right`."""
    return f"imitation {number} of {rounds}: {right:.1%} right"


def described(evaluation: "Evaluation") -> str:
    """An evaluation in one line."""
    when = f"{evaluation.steps:7d} steps, {minutes(evaluation.tank_time):>8} in the tank"
    if evaluation.swam is None:
        when += NOT_COUNTED
    if evaluation.swam is not None and evaluation.policy != evaluation.steps:
        when += f", policy of {evaluation.policy} steps"
    others = f", worst of other fish {evaluation.worst:.1%}" if evaluation.worst is not None else ""
    return f"{when}: {summary(evaluation)}{others}"


def summary(evaluation: "Evaluation") -> str:
    """Its figures, or that the policy does not swim."""
    if evaluation.stalled:
        return "stalled: it does not swim"
    error = evaluation.error
    return figures(evaluation.thrust, evaluation.relative_thrust, evaluation.frequency, error)


def figures(
    thrust: float, relative_thrust: float, frequency: float, error: float | None = None
) -> str:
    """`25.1 mN  97.8%  1.67 Hz`, or `25.1 ± 0.3 mN  97.8%  1.67 Hz`."""
    known = "" if error is None else f" ± {error * 1e3:.1f}"
    return f"{thrust * 1e3:.1f}{known} mN  {relative_thrust:.1%}  {frequency:.2f} Hz"


def minutes(seconds: float) -> str:
    """`6:40`, or `1:06:40`."""
    whole = round(seconds)
    hours, rest = divmod(whole, 3600)
    text = f"{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"
    return f"{hours}:{text}" if hours else text
