"""Displays in the terminal: progress of an experiment, and a full screen.

Progress is a line for each result, and a bar with the time left. The bar goes to standard error, so
that programs can read the output.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from fishd.cli.output import echo
from fishd.core import text
from fishd.core.process.interruption import defer_signals

if TYPE_CHECKING:
    from rich.live import Live
    from rich.progress import Progress, TaskID


class Lines:
    """Printer of a line for each step that is done."""

    def __init__(self, err: bool) -> None:
        """err: whether the lines go to standard error"""
        self._err = err

    def done(self, line: str, amount: float) -> None:
        """Print what was done; amount: amount of the total that is done."""
        echo(line, err=self._err)

    def at(self, amount: float, latest_result: str | None = None) -> None:
        """Show the amount of the total that is done, and a new latest result."""

    def warn(self, line: str) -> None:
        """Print a line on standard error."""
        echo(line, err=True)


class Bar(Lines):
    """Printer of the same lines, above a bar if they are on a terminal, too."""

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

    def at(self, amount: float, latest_result: str | None = None) -> None:
        """Move the bar; the latest result stands to its right."""
        description = None if latest_result is None else text.line(latest_result)
        self._progress.update(self._task, completed=amount, description=description)

    def warn(self, line: str) -> None:
        """Print a line above the bar."""
        self._progress.console.print(
            text.block(line), markup=False, highlight=False, soft_wrap=True
        )


@contextmanager
def show_waiting(work: str) -> Iterator[None]:
    """Show that work of unknown length goes on, if standard error is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(work):
        yield


@contextmanager
def show_progress(total: float, unit: str, *, err: bool = False) -> Iterator[Lines]:
    """Yield a printer of lines, with a bar if standard error is a terminal.

    total: total amount [`unit`]; err: whether the lines go to standard error, since the output is
        for a program
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
    # Output that other code prints meanwhile must not be redirected.
    console = Console(stderr=True)
    with Progress(*columns, console=console, redirect_stdout=False) as progress:
        yield Bar(progress, progress.add_task("", total=total), err)


@contextmanager
def open_full_screen() -> Iterator["Live"]:
    """Yield a display on the alternate screen; restore the previous screen whatever ends this."""
    from rich.live import Live

    live = Live(screen=True, auto_refresh=False)
    try:
        with defer_signals():  # rich does not undo an interrupted start
            live.start()
        yield live
    finally:
        live.stop()
