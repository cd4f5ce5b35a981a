"""The verb that lists recordings."""

import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import click
import msgspec
from msgspec import Struct

from fishd.cli.options import json_option
from fishd.cli.output import counted, echo, print_json
from fishd.cli.recording.choice import damage, folder_option
from fishd.core import text
from fishd.core.console import power_words
from fishd.core.errors import ConfigError, RecordingError
from fishd.lab.experiment import Header, count_rows, list_experiments
from fishd.recording.folder import Glance, glances, runs_folder
from fishd.recording.summary import Summary

WIDE = 1000
LONGEST = 1e9
"""No recording is longer than these thirty years [s]."""


@click.command()
@folder_option
@json_option
def runs(folder: Path | None, as_json: bool) -> int:
    """List recordings and experiments, each the oldest first.

    'thrust' is the mean while it swam, in mN unless another unit is shown, with its 95 % interval.
    Where the zero of the sensor was never known, it is the mean force as measured, drift
    and offset included, ± ?. 'power' went into the servo meanwhile. 'lost' are ticks that fishd
    made and that are not in the file.
    """
    place = folder or runs_folder()
    found = list(glances(place))
    good = [each for each in found if isinstance(each, Glance)]
    experiments = [_Listed.read(*each) for each in list_experiments(place)]
    if as_json:
        print_json([*map(_as_json, good), *experiments])
    else:
        if good:
            _print(good)
        if experiments:
            _print_experiments(experiments)
        if not good and not experiments:
            echo(f"there is no recording in {place} yet; see 'fishctl record --help'")
    wrong = [each for each in found if isinstance(each, RecordingError)]
    problems = [str(error) for error in wrong] + [e.problem for e in experiments if e.problem]
    for problem in problems:
        echo(f"fishctl: {problem}", err=True)
    return 1 if problems else 0


class _Listed(Struct):
    """An experiment in short."""

    name: str
    path: str
    kind: str
    on: str
    began: str
    rows: int | None
    """Rows of its table; None where it has none."""
    problem: str = ""
    """Why it cannot be read, where it cannot."""

    @classmethod
    def read(cls, path: Path, header: "Header | ConfigError") -> "_Listed":
        """Return what the list shows of an experiment."""
        if isinstance(header, ConfigError):
            return cls(path.name, str(path), "–", "–", "", None, str(header))
        rows = count_rows(path)
        return cls(path.name, str(path), header.kind, header.on, header.began, rows)


def _print_experiments(experiments: list[_Listed]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("experiment", overflow="fold")
    for head in ("began", "kind", "fish"):
        table.add_column(head, no_wrap=True)
    table.add_column("rows", justify="right", no_wrap=True)
    for each in experiments:
        rows = "–" if each.rows is None else str(each.rows)
        table.add_row(text.line(each.name), _began(each.began), each.kind, each.on, rows)
    Console(width=None if sys.stdout.isatty() else WIDE, markup=False).print(table)


def _as_json(glance: Glance) -> dict[str, Any]:
    return {
        "kind": "recording",
        "name": glance.name,
        "path": str(glance.path),
        "state": _state(glance),
        "damaged": glance.damaged,
        "duration": glance.summary.duration,
        **msgspec.structs.asdict(glance.summary),
        "about": glance.about,
    }


def _print(found: list[Glance]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("run", overflow="fold")
    for head in ("began", "length", "thrust", "power", "ticks", "lost", "marks"):
        table.add_column(head, justify="right", no_wrap=True)
    for head in ("swam", "about"):
        table.add_column(head, overflow="fold")
    for glance in found:
        summary = glance.summary
        table.add_row(
            text.line(glance.name),
            _began(glance.about.get("started", "")),
            _length(summary.duration),
            _thrust(summary),
            "–" if summary.power is None else power_words(summary.power),
            str(summary.ticks),
            str(summary.lost),
            str(summary.marks),
            text.line(", ".join(summary.swimming) or "–"),
            text.line("; ".join(_remarks(glance))),
        )
    # In a file or a pipe nothing is wrapped.
    Console(width=None if sys.stdout.isatty() else WIDE, markup=False).print(table)


def _thrust(summary: Summary) -> str:
    """In mN, or thousandths of another unit; with its interval where the zero was known."""
    if summary.thrust is None:
        return "–"
    error = "?" if summary.thrust_error is None else _thousandths(summary.thrust_error)
    unit = "" if summary.force_unit == "N" else f" m{text.quoted(summary.force_unit)}"
    if error == "0.00":  # of no noise
        name = "" if summary.force_unit == "N" else summary.force_unit
        return text.format_measured(summary.thrust, summary.thrust_error, name)
    return f"{_thousandths(summary.thrust)} ± {error}{unit}"


def _thousandths(value: float) -> str:
    shown = value * 1e3
    return f"{shown:.2f}" if abs(shown) < 1e6 else f"{shown:.3g}"


def _remarks(glance: Glance) -> list[str]:
    state = _state(glance)
    restarts = glance.summary.restarts
    return [
        *([state] if state != "finished" else []),
        *([damage(glance.damaged)] if glance.damaged is not None else []),
        *([counted(restarts, "restart")] if restarts else []),
        *([_frames(glance.summary)] if glance.summary.frames else []),
        *(glance.about[key] for key in ("subject", "note") if glance.about.get(key)),
    ]


def _frames(summary: Summary) -> str:
    found = counted(summary.frames, "frame")
    if summary.frames_lost:
        return f"{found}, {summary.frames_lost} lost"
    gaps = counted(summary.frame_gaps, "gap")
    return f"{found}, {gaps}" if summary.frame_gaps else found


def _state(glance: Glance) -> str:
    if glance.writing:
        return "recording"
    return "finished" if glance.finished else "unfinished"


def _began(iso: str) -> str:
    try:
        return f"{datetime.fromisoformat(iso):%Y-%m-%d %H:%M}"
    except ValueError:
        return "–"


def _length(seconds: float) -> str:
    if not 0.0 <= seconds <= LONGEST:  # of a file in which no times stand
        return f"{seconds:.3g} s"
    minutes, rest = divmod(seconds, 60.0)
    hours, minutes = divmod(int(minutes), 60)
    if hours:
        return f"{hours}:{minutes:02}:{rest:02.0f}"
    return f"{minutes}:{rest:04.1f}" if minutes else f"{rest:.1f} s"
