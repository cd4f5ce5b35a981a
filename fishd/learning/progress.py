"""What a person sees of a training: a live bar on a terminal, else a line an evaluation."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

import click

if TYPE_CHECKING:
    from rich.progress import TaskID

    from fishd.learning.checkpoints import Evaluation


class Show(Protocol):
    """Is told how a training goes on."""

    def begin(self, steps: int, target: int, says: str) -> None:
        """The training begins, or goes on, after so many steps; says: what and where, one line."""

    def step(self, tank_time: float) -> None:
        """One more control step is done; tank_time in seconds."""

    def update(self, steps: int, thrust: float, efficiency: float, frequency: float) -> None:
        """An update is done; the figures are those of its rollout, thrust in N, Hz."""

    def evaluated(self, evaluation: "Evaluation", best: bool) -> None:
        """A deterministic evaluation is done; best: none before was as good."""

    def say(self, text: str) -> None:
        """One line for people."""


class Quiet:
    """Shows nothing."""

    def begin(self, steps: int, target: int, says: str) -> None:
        """Nothing."""

    def step(self, tank_time: float) -> None:
        """Nothing."""

    def update(self, steps: int, thrust: float, efficiency: float, frequency: float) -> None:
        """Nothing."""

    def evaluated(self, evaluation: "Evaluation", best: bool) -> None:
        """Nothing."""

    def say(self, text: str) -> None:
        """Nothing."""


class Lines(Quiet):
    """A line for each evaluation, for logs and pipes."""

    _best = 0.0
    """The highest merit so far, as shown."""

    def begin(self, steps: int, target: int, says: str) -> None:
        """Where the run is."""
        self.say(says)

    def evaluated(self, evaluation: "Evaluation", best: bool) -> None:
        """One line; best is said of what is better to the eye."""
        merit = round(evaluation.merit, 3)
        better = best and merit > self._best
        self._best = max(self._best, merit) if best else self._best
        self.say(described(evaluation) + (", the best so far" if better else ""))

    def say(self, text: str) -> None:
        """One line, at once."""
        click.echo(text)
        sys.stdout.flush()


class Bar(Lines):
    """A progress bar with thrust, efficiency, frequency, tank time and time left."""

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
        self._exploring = ""
        self._evaluation = ""

    def begin(self, steps: int, target: int, says: str) -> None:
        """Show the bar."""
        self.say(says)
        self._task = self._progress.add_task(
            "", completed=steps, total=target, figures="", tank="0:00"
        )
        self._progress.start()

    def step(self, tank_time: float) -> None:
        """Move on by one."""
        self._progress.update(self._task, advance=1, tank=minutes(tank_time))

    def update(self, steps: int, thrust: float, efficiency: float, frequency: float) -> None:
        """Show how the fish swam while it explored, until an evaluation says it better."""
        self._exploring = figures(thrust, efficiency, frequency)
        self._refresh(steps)

    def evaluated(self, evaluation: "Evaluation", best: bool) -> None:
        """Show how it swims."""
        self._evaluation = (
            "stalled"
            if evaluation.stalled
            else figures(evaluation.thrust, evaluation.efficiency, evaluation.frequency)
        )
        self._refresh(evaluation.steps)

    def say(self, text: str) -> None:
        """One line above the bar."""
        self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def _refresh(self, steps: int) -> None:
        shown = self._evaluation or self._exploring
        self._progress.update(self._task, completed=steps, figures=shown)

    @contextmanager
    def shown(self) -> Iterator["Bar"]:
        """While the bar may be on the terminal; it is from `begin` on."""
        try:
            yield self
        finally:
            self._progress.stop()


@contextmanager
def on_terminal() -> Iterator[Show]:
    """The bar where standard output is a terminal, else lines."""
    if sys.stdout.isatty():
        with Bar().shown() as bar:
            yield bar
    else:
        yield Lines()


def described(evaluation: "Evaluation") -> str:
    """An evaluation in one line."""
    if evaluation.stalled:
        swims = "stalled: the tail does not beat"
    else:
        swims = figures(evaluation.thrust, evaluation.efficiency, evaluation.frequency)
    if evaluation.worst is not None:
        swims += f", worst of other fish {evaluation.worst:.1%}"
    return f"{evaluation.steps:7d} steps, {minutes(evaluation.tank_time):>8} in the tank: {swims}"


def figures(thrust: float, efficiency: float, frequency: float) -> str:
    """`25.1 mN  97.8%  1.67 Hz`."""
    return f"{thrust * 1e3:.1f} mN  {efficiency:.1%}  {frequency:.2f} Hz"


def minutes(seconds: float) -> str:
    """`6:40`, or `1:06:40`."""
    whole = round(seconds)
    hours, rest = divmod(whole, 3600)
    text = f"{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"
    return f"{hours}:{text}" if hours else text
