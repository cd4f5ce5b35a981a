"""What `fishctl sweep` says: each point as it is done, and what is best in the end."""

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from fishd.cli.lab_progress import Lines, showing
from fishd.cli.output import counted, echo, print_json, warn_of_fin
from fishd.core import text
from fishd.core.console import INTERRUPTED

if TYPE_CHECKING:
    from fishd.lab.sweep.curves import Best, WholeTicks
    from fishd.lab.sweep.folder import SweepFolder
    from fishd.lab.sweep.grid import Point
    from fishd.lab.sweep.results import Found, Quantity


class Count:
    """Tells what is done, point by point."""

    def __init__(self, show: Lines, before: int, each: float, quantity: "Quantity") -> None:
        self._show = show
        self._finished = before
        self._each = each
        self._quantity = quantity

    def done(self, point: "Point", result: "Found") -> None:
        """A point is done."""
        self._finished += 1
        self._show.done(
            f"{point.label()}: {_figures(result, self._quantity)}", self._finished * self._each
        )

    def at(self, seconds: float) -> None:
        """The present point has taken so long [s]."""
        self._show.at(self._finished * self._each + seconds)


@contextmanager
def telling(
    folder: "SweepFolder", found: "list[Point]", unit: str, each: float, err: bool
) -> "Iterator[Count]":
    """each: what a point counts, in `unit`."""
    before = sum(folder.key(point) in folder.results for point in found)
    there = f", {before} of them there already" if before else ""
    echo(f"{folder.path}: {counted(len(found), 'point')}{there}", err=err)
    with showing(len(found) * each, unit, err=err) as show:
        show.at(before * each)
        yield Count(show, before, each, folder.begun.quantity)


def _figures(result: "Found", quantity: "Quantity") -> str:
    if result.value is None:
        return f"no {quantity.name}: {result.trouble}"
    beats = f", {result.beat_frequency:.2f} Hz" if result.beat_frequency else ""
    steady = "" if getattr(result, "settled", 0.0) is not None else ", not yet steady"
    return f"{text.format_measured(result.value, result.error, quantity.unit)}{beats}{steady}"


def conclude(
    folder: "SweepFolder",
    found: "list[Point]",
    units: dict[str, str],
    error_of: str,
    whole: bool,
    as_json: bool,
) -> int:
    """Say what is best, and draw what there is; the exit status."""
    from fishd.lab.sweep import curves, figure

    drawn = curves.curves(folder, found)
    quantity = folder.begun.quantity
    unit = quantity.unit
    bests = [
        (curve, msgspec.structs.replace(best, whole_ticks=curves.whole_ticks(folder, curve)))
        for curve in drawn
        if (best := curves.best(curve))
    ]
    if as_json:
        print_json([curves.plain(best, quantity) for _, best in bests])
    else:
        for curve, best in bests:
            echo(f"{curve.label}: {_proposal(best, units.get(best.over, ''), unit)}")
            if best.whole_ticks:
                echo(f"{curve.label}, of whole ticks: {_measured(best.whole_ticks, unit)}")
        echo(f"table: {folder.path / 'points.csv'}")
    if any(curve.peak for curve in drawn):
        stem = folder.path / quantity.name
        pictures = figure.draw(stem, drawn, units, error_of=error_of, quantity=quantity)
        if not as_json:
            echo(f"picture: {pictures[0]}, and as {pictures[1].suffix[1:].upper()}")
    fins = [
        (getattr(result, "fin_amplitude", None) or 0.0, point.label())
        for point in found
        if (result := folder.results.get(folder.key(point)))
    ]
    if fins:
        widest, where = max(fins)
        warn_of_fin(widest, f" at {where}")
    if not whole:
        done = sum(folder.key(point) in folder.results for point in found)
        echo(
            f"fishctl: stopped after {done} of {counted(len(found), 'point')}; to go on: "
            f"{again(folder.path)}",
            err=True,
        )
        return INTERRUPTED
    troubles = [point for point in found if folder.results[folder.key(point)].trouble]
    return 1 if troubles else 0


def _proposal(best: "Best", unit: str, of: str) -> str:
    symbol = "" if unit in ("", "1") else f" {unit}"
    value = text.format_measured(best.value, best.error, of)
    if best.x is None:
        return value
    if best.at_edge:
        return (
            f"best measured at {best.over} {best.x:g}{symbol}, {value}: at the edge of the grid, "
            "so the best may lie beyond it"
        )
    if best.x_low is None or best.x_high is None:
        return f"best measured at {best.over} {best.x:.4g}{symbol}: {value}"
    interval = f"[{best.x_low:.4g}, {best.x_high:.4g}]"
    return f"best {best.over} {best.x:.4g}{symbol} {interval}: {value}"


def _measured(found: "WholeTicks", force_unit: str) -> str:
    thrust = text.format_measured(found.thrust, found.error, force_unit)
    best = f"best measured at {found.frequency:.4g} Hz: {thrust}"
    if found.nearer is None:
        return best
    return f"{best}; {found.nearer:.6g} Hz is nearer the best, and not in the grid"


def again(folder: Path) -> str:
    """The command line that resumes a sweep."""
    words = sys.argv[1:]
    if not any(word == "--folder" or word.startswith("--folder=") for word in words):
        words = [*words, "--folder", str(folder)]
    return shlex.join(["fishctl", *words])
