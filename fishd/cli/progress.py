"""Displays in the terminal: progress of an experiment, and a full screen.

Progress is a line for each result, and a bar with the time left. The bar goes to standard error, so
that programs can read the output. For a page, there are lines of JSON instead of the bar.
"""

import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from fishd.cli.output import echo, print_json_line
from fishd.core import text
from fishd.core.experiments import PROGRESS_VARIABLE, CurvePoint, Estimate, Progress
from fishd.core.process.interruption import defer_signals

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID

REPORT_PERIOD_S = 0.5
"""Shortest time between two reports of the amount alone [s]."""
WIDTH_BESIDE_BAR = 48
"""Characters for the amount and the times beside a bar."""


class Lines:
    """Printer of a line for each step that is done."""

    def __init__(self, err: bool) -> None:
        """err: whether the lines go to standard error"""
        self._err = err

    def done(self, line: str, amount: float, point: CurvePoint | None = None) -> None:
        """Print what was done; amount: amount of the total that is done; point: its result."""
        echo(line, err=self._err)

    def at(self, amount: float, latest_result: str | None = None) -> None:
        """Show the amount of the total that is done, and a new latest result."""

    def estimate(self, estimates: Sequence[Estimate], point: CurvePoint | None = None) -> None:
        """Show the best values until now; point: a new point of their curve."""

    def warn(self, line: str) -> None:
        """Print a line on standard error."""
        echo(line, err=True)


class Bar(Lines):
    """Printer of the same lines, above a bar if they are on a terminal, too."""

    def __init__(self, progress: "RichProgress", task: "TaskID", err: bool) -> None:
        super().__init__(err)
        self._progress = progress
        self._task = task

    def done(self, line: str, amount: float, point: CurvePoint | None = None) -> None:
        """Print the line, move the bar."""
        if self._err or sys.stdout.isatty():
            echo_above = self._progress.console.print
            echo_above(text.block(line), markup=False, highlight=False, soft_wrap=True)
        else:
            super().done(line, amount)
        self.at(amount)

    def at(self, amount: float, latest_result: str | None = None) -> None:
        """Move the bar; the latest result stands below it."""
        description = None if latest_result is None else text.line(latest_result)
        self._progress.update(self._task, completed=amount, description=description)

    def estimate(self, estimates: Sequence[Estimate], point: CurvePoint | None = None) -> None:
        """Show the values below the bar."""
        description = ", ".join(map(format_estimate, estimates))
        self._progress.update(self._task, description=text.line(description))

    def warn(self, line: str) -> None:
        """Print a line above the bar."""
        self._progress.console.print(
            text.block(line), markup=False, highlight=False, soft_wrap=True
        )


class Reports(Lines):
    """Printer of the same lines, and of a `Progress` as JSON on standard error, for a page."""

    def __init__(self, total: float, err: bool) -> None:
        super().__init__(err)
        self._total, self._amount, self._doing = total, 0.0, ""
        self._first: tuple[float, float] | None = None
        """Time of the first report, and its share [s, 1]."""
        self._reported = 0.0

    def done(self, line: str, amount: float, point: CurvePoint | None = None) -> None:
        """Print the line, report the point."""
        super().done(line, amount, point)
        self._amount = amount
        self._report(point=point)

    def at(self, amount: float, latest_result: str | None = None) -> None:
        """Report the amount and the step, unless that was done just before."""
        self._amount, before = amount, self._doing
        self._doing = before if latest_result is None else text.line(latest_result)
        if self._doing != before or time.monotonic() - self._reported >= REPORT_PERIOD_S:
            self._report()

    def estimate(self, estimates: Sequence[Estimate], point: CurvePoint | None = None) -> None:
        """Report the values."""
        self._report(list(estimates), point)

    def _report(
        self, estimates: list[Estimate] | None = None, point: CurvePoint | None = None
    ) -> None:
        self._reported = now = time.monotonic()
        share = min(1.0, self._amount / self._total) if self._total else 0.0
        since, before = self._first = self._first or (now, share)
        rate = (share - before) / (now - since) if now > since else 0.0
        remaining = (1.0 - share) / rate if rate else None
        report_progress(Progress(share, remaining, self._doing, estimates, point))


def report_progress(progress: Progress) -> None:
    """Print the state of an experiment for a page, if this process was started by one."""
    if is_for_page():
        print_json_line({"progress": progress}, err=True)


def is_for_page() -> bool:
    """Return whether a page reads the standard error of this process."""
    return os.environ.get(PROGRESS_VARIABLE) == "json"


def format_estimate(estimate: Estimate) -> str:
    """Return a value with its unit and its interval: `frequency 1.7 Hz [1.6, 1.8]`."""
    unit = "" if estimate.unit in ("", "1") else f" {estimate.unit}"
    known = estimate.low is not None and estimate.high is not None
    interval = f" [{estimate.low:.4g}, {estimate.high:.4g}]" if known else ""
    return f"{estimate.name} {estimate.value:.4g}{unit}{interval}"


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
        yield Reports(total, err) if is_for_page() else Lines(err)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class ProgressWithResult(Progress):
        """A bar with the latest result below it, which has no room beside it."""

        def get_renderables(self) -> Iterator["RenderableType"]:
            yield from super().get_renderables()
            if self.tasks and self.tasks[0].description:
                yield Text(self.tasks[0].description)

    # Output that other code prints meanwhile must not be redirected.
    console = Console(stderr=True)
    bar_width = min(30, console.width - WIDTH_BESIDE_BAR)
    has_bar = bar_width >= 5  # else the times would be cut off instead
    columns = (
        TextColumn("{task.completed:.0f} of {task.total:.0f} " + unit),
        *([BarColumn(bar_width=bar_width)] if has_bar else []),
        TimeElapsedColumn(),
        TextColumn("passed,"),
        TimeRemainingColumn(compact=not has_bar),
        TextColumn("left"),
    )
    with ProgressWithResult(*columns, console=console, redirect_stdout=False) as progress:
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
