"""What a person sees of an experiment: a bar with the time left on a terminal, else lines."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from fishd.cli.output import echo

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


class Lines:
    """A line for each thing that is done, for logs and pipes."""

    def __init__(self, err: bool) -> None:
        """err: on standard error"""
        self._err = err

    def done(self, line: str, amount: float) -> None:
        """Say what was done; amount: how much of the total is done by now."""
        echo(line, err=self._err)

    def at(self, amount: float) -> None:
        """Say how much of the total is done by now."""


class Bar(Lines):
    """The same above a bar."""

    def __init__(self, progress: "Progress", task: "TaskID") -> None:
        super().__init__(err=False)
        self._progress = progress
        self._task = task

    def done(self, line: str, amount: float) -> None:
        """Print the line, move the bar."""
        echo_above = self._progress.console.print
        echo_above(line, markup=False, highlight=False, soft_wrap=True)
        self.at(amount)

    def at(self, amount: float) -> None:
        """Move the bar."""
        self._progress.update(self._task, completed=amount)


@contextmanager
def showing(total: float, unit: str, *, err: bool = False) -> Iterator[Lines]:
    """A bar where it can be seen, else lines.

    total: in `unit`; err: on standard error, since the output is for a program
    """
    stream = sys.stderr if err else sys.stdout
    if not stream.isatty():
        yield Lines(err)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.completed:.0f} of {task.total:.0f} " + unit),
        BarColumn(bar_width=30),
        TimeElapsedColumn(),
        TextColumn("passed,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Progress(*columns, console=Console(file=stream)) as progress:
        yield Bar(progress, progress.add_task("", total=total))
