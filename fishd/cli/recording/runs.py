"""The verb that lists recordings and experiments; `fishd.cli.recording.stored` has its verbs."""

import shlex
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, cast

import click
import msgspec

from fishd.cli.options import json_option
from fishd.cli.output import echo, echo_table, format_count, print_json
from fishd.cli.recording import stored
from fishd.cli.recording.files import folder_option
from fishd.core import text
from fishd.core.console import format_power
from fishd.core.errors import ConfigError, RecordingError
from fishd.lab.experiment import (
    Answer,
    Header,
    On,
    count_rows,
    find_answer,
    is_in_use,
    list_experiments,
)
from fishd.recording.folder import Overview, read_overviews
from fishd.recording.notes import read_note
from fishd.recording.summary import Summary

MAX_DURATION_S = 1e9
"""Longest duration that is shown as hours and minutes, about thirty years [s]."""


@click.group(invoke_without_command=True)
@folder_option
@json_option
@click.pass_context
def runs(ctx: click.Context, folder: Path, as_json: bool) -> int:
    """List recordings and experiments, each the oldest first, by their running numbers.

    'thrust' is the mean while the fish swam, in mN unless another unit is shown, with its 95 %
    confidence interval, which includes the calibration where that is known. If the zero of the
    sensor was never known, it is the mean measured force with drift and offset, and its interval is
    '?'. An experiment shows its result or, before its end, the largest thrust so far; a search
    shows none before its end.
    'power' is the mean power into the servo. 'lost' counts ticks of fishd that are not in the file.
    """
    if ctx.invoked_subcommand:
        return 0
    recordings = list(read_overviews(folder))
    readable = [entry for entry in recordings if isinstance(entry, Overview)]
    experiments = [_summarise(*entry) for entry in list_experiments(folder)]
    if as_json:
        print_json([*map(_to_json, readable), *experiments])
    else:
        if readable:
            _print_recordings(readable)
        if experiments:
            _print_experiments(experiments)
        if not readable and not experiments:
            echo(f"there is no recording in {folder} yet; see 'fishctl record --help'")
    errors = [entry for entry in recordings if isinstance(entry, RecordingError)]
    problems = [str(error) for error in errors] + [
        e["problem"] for e in experiments if e["problem"]
    ]
    for problem in problems:
        echo(f"fishctl: {problem}", err=True)
    return 1 if problems else 0


_SHOWN_FACTS = ("kind", "on", "began", "force_unit", "command", "number")


for verb in stored.VERBS:
    runs.add_command(verb)


def _summarise(path: Path, header: Header | ConfigError) -> dict[str, Any]:
    """Return an experiment as the list shows it, also one that cannot be read."""
    if isinstance(header, Header):
        answer = find_answer(path, header.kind)
        rows, state = count_rows(path), _find_state(path, header)
    else:
        answer, rows, state = Answer(problem=str(header)), None, ""
        header = Header(kind="–", on=cast(On, "–"))
    facts = {name: getattr(header, name) for name in _SHOWN_FACTS}
    duration = _find_duration(header) if answer.duration is None else answer.duration
    return {
        "name": path.name, "path": str(path), **facts, "rows": rows, "state": state,
        **answer._asdict(), "duration": duration, "about": _name_fish(header) | read_note(path),
    }  # fmt: skip


def _find_duration(header: Header) -> float | None:
    """Return the time from the begin to the end of an experiment [s]; None where it is unknown."""
    with suppress(ValueError, TypeError):  # TypeError: only one of them has a time zone
        begin, end = map(datetime.fromisoformat, (header.began, header.ended or ""))
        return max(0.0, (end - begin).total_seconds())
    return None


def _name_fish(header: Header) -> dict[str, str]:
    """Return the name of the fish in its configuration, as the subject of an experiment."""
    name = header.config.get("name")
    return {"subject": name} if isinstance(name, str) else {}


def _find_state(path: Path, header: Header) -> str:
    if is_in_use(path):
        return "running"
    return "" if header.ended is None else "finished" if header.ended else "unfinished"


def _print_experiments(experiments: list[dict[str, Any]]) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("experiment", overflow="fold")
    table.add_column("began", no_wrap=True)
    table.add_column("command", overflow="fold")
    for head in ("length", "rows", "thrust"):
        table.add_column(head, justify="right", no_wrap=True)
    table.add_column("about", overflow="fold")
    for experiment in experiments:
        rows, duration = experiment["rows"], experiment["duration"]
        half_width = experiment["total_ci95"] or experiment["thrust_ci95"]
        state = "" if experiment["state"] == "finished" else experiment["state"]
        about = [state, experiment["summary"], text.line(experiment["about"].get("note", ""))]
        table.add_row(
            text.line(experiment["name"]),
            _format_start(experiment["began"]),
            text.line(f"{experiment['kind']} {shlex.join(experiment['command'])}".strip()),
            "–" if duration is None else _format_duration(duration),
            "–" if rows is None else str(rows),
            _format_thrust(experiment["thrust"], half_width, experiment["force_unit"]),
            "; ".join(filter(None, about)),
        )
    echo_table(table)


def _to_json(glance: Overview) -> dict[str, Any]:
    return {
        "kind": "recording",
        "name": glance.name,
        "path": str(glance.path),
        "state": _format_state(glance),
        "problem": glance.problem,
        "recorded_ticks": glance.recorded_ticks,
        **msgspec.structs.asdict(glance.summary),
        "about": glance.about,
    }


def _print_recordings(recordings: list[Overview]) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("run", overflow="fold")
    for head in ("began", "length", "thrust", "power", "ticks", "lost", "marks"):
        table.add_column(head, justify="right", no_wrap=True)
    for head in ("swam", "about"):
        table.add_column(head, overflow="fold")
    for glance in recordings:
        summary = glance.summary
        table.add_row(
            text.line(glance.name),
            _format_start(glance.about.get("started", "")),
            _format_duration(summary.duration),
            _format_thrust(summary.thrust, summary.thrust_ci95, summary.force_unit),
            format_power(summary.readings["power"]) if "power" in summary.readings else "–",
            str(summary.ticks),
            str(summary.lost_ticks),
            str(summary.marks),
            text.line(", ".join(summary.swim_ticks) or "–"),
            text.line("; ".join(_format_remarks(glance))),
        )
    echo_table(table)


def _format_thrust(thrust: float | None, half_width: float | None, force_unit: str) -> str:
    """Return the thrust in mN, or thousandths of another unit, with its interval if known."""
    if thrust is None:
        return "–"
    error = "?" if half_width is None else _format_thousandths(half_width)
    if error == "0.00":  # a thrust without noise
        return text.format_measured(thrust, half_width, "" if force_unit == "N" else force_unit)
    unit = "" if force_unit == "N" else f" m{text.quoted(force_unit)}"
    return f"{_format_thousandths(thrust)} ± {error}{unit}"


def _format_thousandths(value: float) -> str:
    thousandths = value * 1e3
    return f"{thousandths:.2f}" if abs(thousandths) < 1e6 else f"{thousandths:.3g}"


def _format_remarks(glance: Overview) -> list[str]:
    state = _format_state(glance)
    restarts = glance.summary.restarts
    return [
        *([state] if state != "finished" else []),
        *([glance.problem] if glance.problem else []),
        *([format_count(restarts, "restart")] if restarts else []),
        *([_format_frames(glance.summary)] if glance.summary.frames else []),
        *map(str, glance.summary.clock_steps),
        *(glance.about[key] for key in ("subject", "note") if glance.about.get(key)),
    ]


def _format_frames(summary: Summary) -> str:
    frames = format_count(summary.frames, "frame")
    if summary.lost_frames:
        return f"{frames}, {summary.lost_frames} lost"
    gaps = format_count(summary.frame_gaps, "gap")
    return f"{frames}, {gaps}" if summary.frame_gaps else frames


def _format_state(glance: Overview) -> str:
    if glance.writing:
        return "recording"
    return "finished" if glance.finished else "unfinished"


def _format_start(iso: str) -> str:
    try:
        return f"{datetime.fromisoformat(iso):%Y-%m-%d %H:%M}"
    except ValueError:
        return "–"


def _format_duration(seconds: float) -> str:
    if not 0.0 <= seconds <= MAX_DURATION_S:  # a file without times
        return f"{seconds:.3g} s"
    minutes, remainder = divmod(seconds, 60.0)
    hours, minutes = divmod(int(minutes), 60)
    if hours:
        return f"{hours}:{minutes:02}:{remainder:02.0f}"
    return f"{minutes}:{remainder:04.1f}" if minutes else f"{remainder:.1f} s"
