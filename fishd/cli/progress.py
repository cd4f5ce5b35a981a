"""What a person sees of an experiment: lines of what is done, and a bar with the time left.

The bar goes to standard error, so that the output is clean for a program.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from fishd.cli.output import echo
from fishd.core import text

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


class Lines:
    """A line for each thing that is done."""

    def __init__(self, err: bool) -> None:
        """err: on standard error"""
        self._err = err

    def done(self, line: str, amount: float) -> None:
        """Say what was done; amount: how much of the total is done by now."""
        echo(line, err=self._err)

    def at(self, amount: float, found: str = "") -> None:
        """Say how much of the total is done by now, and what was found so far."""

    def warn(self, line: str) -> None:
        """Say a line on standard error."""
        echo(line, err=True)


class Bar(Lines):
    """The same, above a bar where they are on a terminal, too."""

    def __init__(self, progress: "Progress", task: "TaskID", err: bool) -> None:
        super().__init__(err)
        self._progress = progress
        self._task = task

    def done(self, line: str, amount: float) -> None:
        """Print the line, move the bar."""
        if self._err or sys.stdout.isatty():
            echo_above = self._progress.console.print
            echo_above(text.block(line), markup=False, highlight=False, soft_wrap=True)
        else:
            super().done(line, amount)
        self.at(amount)

    def at(self, amount: float, found: str = "") -> None:
        """Move the bar; what was found so far stands behind it."""
        self._progress.update(self._task, completed=amount, description=text.line(found))

    def warn(self, line: str) -> None:
        """Print it above the bar."""
        self._progress.console.print(
            text.block(line), markup=False, highlight=False, soft_wrap=True
        )


@contextmanager
def showing(total: float, unit: str, *, err: bool = False) -> Iterator[Lines]:
    """Lines, and a bar where it can be seen.

    total: in `unit`; err: the lines are on standard error, since the output is for a program
    """
    if not sys.stderr.isatty():
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
        TextColumn("{task.description}", markup=False),
    )
    # What is printed elsewhere meanwhile is not the bar's to redirect.
    console = Console(stderr=True)
    with Progress(*columns, console=console, redirect_stdout=False) as progress:
        yield Bar(progress, progress.add_task("", total=total), err)
