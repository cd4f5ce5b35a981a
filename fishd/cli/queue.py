"""The verbs of the queue of experiments of a fish."""

import io
import shlex
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from datetime import datetime, timedelta
from functools import wraps
from typing import Any

import click
import msgspec

from fishd.cli.options import F, Utf8Text, daemon_options, take_option, verb_lease
from fishd.cli.output import echo, echo_table, format_count, print_json
from fishd.core.errors import FishdError, NoDaemon
from fishd.core.experiment_queue import MAX_ITEMS, MAX_REPEAT, QueueFile, View
from fishd.core.experiments import Plan
from fishd.recording.folder import runs_folder

EXPERIMENTS = (
    "measure", "sweep", "compare", "optimise", "identify --experiment", "adapt", "learn ppo",
)  # fmt: skip
"""Verbs that a queue takes, with the words that make each an experiment."""
MAX_CLOCK_S = 3e7
"""Longest duration of a queue for which the time of its end is shown [s]."""
_CHOSEN_OPTIONS = {
    "--folder", "--resume", "--endpoint", "--json", "--take", "--dry-run", "--help", "-h",
}  # fmt: skip
"""Options of an experiment that the queue chooses."""


@click.group()
def queue() -> None:
    """Keep experiments in a queue, and run one after another.

    The queue of a fish is a file in the folder of runs, which survives a restart. It runs after
    'fishctl queue start' or a start on the page. It pauses when an experiment fails, when the fish
    has a fault or an emergency stop, and on request, and never starts again by itself. What was
    interrupted is resumed at the next start.
    """


def _queue_options(function: F) -> F:
    """Add `--endpoint` and `--json`, and pass the file of the queue as `file`."""

    @wraps(function)
    def open_file(*args: Any, endpoint: str | None, **values: Any) -> Any:
        return function(*args, file=QueueFile(runs_folder(), endpoint), **values)

    return daemon_options(open_file)  # type: ignore[return-value]


@queue.command(context_settings={"ignore_unknown_options": True})
@click.argument("words", nargs=-1, type=Utf8Text(), required=True, metavar="VERB [ARGUMENT]...")
@click.option(
    "--repeat",
    type=click.IntRange(1, MAX_REPEAT),
    default=1,
    show_default=True,
    help="Number of runs of it.",
)
@_queue_options
@click.pass_context
def add(
    context: click.Context, words: tuple[str, ...], repeat: int, file: QueueFile, as_json: bool
) -> None:
    """Add an experiment: the words after 'fishctl'.

    For example: fishctl queue add measure swing --for 60 --repeat 3. The words are checked now, as
    their verb does before the fish swims.
    """
    taken = map(str.split, EXPERIMENTS)
    if not any(words[0] == verb and {*needed} <= {*words} for verb, *needed in taken):
        raise click.UsageError(
            f"'{shlex.join(words)}' is not an experiment; a queue takes: {', '.join(EXPERIMENTS)}"
        )
    for word in words:
        if word.partition("=")[0] in _CHOSEN_OPTIONS:
            raise click.UsageError(f"{word.partition('=')[0]} is chosen by the queue; leave it out")
    seconds = _check(context.find_root().command, words, file.address)
    with file.changing() as content:
        item = content.add(list(words), repeat, seconds)
    if as_json:
        print_json(item)
    else:
        each = "" if seconds is None else f", {_format_duration(seconds)} each"
        runs = format_count(repeat, "run")
        echo(f"experiment {item.id}: {shlex.join(words)} ({runs}{each})")


def _check(fishctl: click.Command, words: Sequence[str], address: str) -> float | None:
    """Return the expected duration of an experiment [s]; None if it is not known.

    What only its fishd knows is not checked if that does not answer. Raises the errors of the verb.
    """
    place = ["--folder", "checked", "--dry-run", "--json"]
    plan = io.StringIO()
    try:
        with redirect_stdout(plan):
            fishctl.main(
                ["--endpoint", address, *words, *place],
                prog_name="fishctl",
                standalone_mode=False,
            )
    except NoDaemon:
        return None
    return msgspec.json.decode(plan.getvalue(), type=Plan).seconds


@queue.command("list")
@_queue_options
def list_items(file: QueueFile, as_json: bool) -> None:
    """Show what runs, what waits, how long it takes, and what has ended."""
    show_queue(file, as_json)


def show_queue(file: QueueFile, as_json: bool) -> None:
    """Print a queue; raise `QueueError`."""
    view = file.view()
    if as_json:
        print_json(view)
        return
    if view.items:
        from rich.table import Table

        table = Table("", "experiment", "runs", "each", box=None, pad_edge=False)
        for item in view.items:
            state = ", it runs" if item.id == view.current else ", interrupted" if item.run else ""
            each = "?" if item.seconds is None else _format_duration(item.seconds)
            words = f"{shlex.join(item.words)}{state}"
            table.add_row(str(item.id), words, str(item.repeat), each)
        echo_table(table)
    for past in view.past:
        result = f": {past.message}" if past.message else ""
        echo(f"{_format_time(past.ended)} {past.run} {past.outcome}{result}")
    echo(f"the queue {_describe(view)}")


def _describe(view: View) -> str:
    """Return state, duration and end of a queue in words."""
    if view.state == "empty":
        return "is empty"
    start = view.reason or "start it with 'fishctl queue start'"
    parts = ["runs" if view.state == "running" else f"pauses: {start}"]
    at_least = "at least" if view.unknown else "about"
    parts.append(f"{at_least} {_format_duration(view.left)}")
    if view.left < MAX_CLOCK_S:
        parts[-1] += f", until {_format_time(time.time() + view.left)} from now"
    if view.pauses:
        parts.append("it pauses after this run")
    if view.pause_at is not None:
        parts.append(f"it stops at {_format_time(view.pause_at)}")
    return "; ".join(parts)


def _format_duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _format_time(t: float) -> str:
    """Return a unix time as local time of day, with the date unless it is today."""
    when = datetime.fromtimestamp(t)
    return f"{when:%H:%M}" if when.date() == datetime.now().date() else f"{when:%Y-%m-%d %H:%M}"


@queue.command()
@click.argument("number", type=int)
@click.argument("position", type=click.IntRange(1, MAX_ITEMS))
@_queue_options
def move(number: int, position: int, file: QueueFile, as_json: bool) -> None:
    """Move an experiment; position 1 is the first."""
    with file.changing() as content:
        content.move(number, position)
    show_queue(file, as_json)


@queue.command()
@click.argument("number", type=int)
@_queue_options
def remove(number: int, file: QueueFile, as_json: bool) -> None:
    """Remove an experiment that does not run. What it has measured is kept."""
    with file.changing() as content:
        content.remove(number)
    show_queue(file, as_json)


@queue.command()
@_queue_options
def clear(file: QueueFile, as_json: bool) -> None:
    """Remove all experiments but the one that runs. All runs are kept."""
    with file.changing() as content:
        content.clear()
    show_queue(file, as_json)


def _read_time_of_day(_: click.Context, __: click.Parameter, value: str | None) -> float | None:
    """Return the next unix time with this local time of day [s]."""
    if value is None:
        return None
    try:
        time_of_day = datetime.strptime(value, "%H:%M").time()
    except ValueError:
        raise click.BadParameter(f"'{value}' is not a time of day; write HH:MM") from None
    now = datetime.now()
    when = datetime.combine(now.date(), time_of_day)
    return (when if when > now else when + timedelta(days=1)).timestamp()


@queue.command()
@click.option("--now", is_flag=True, help="Interrupt the run that goes on; it is resumed later.")
@click.option(
    "--at",
    metavar="HH:MM",
    callback=_read_time_of_day,
    help="Interrupt what runs at this time of day.",
)
@click.option("--cancel", is_flag=True, help="Do not pause after this run, nor at a time.")
@_queue_options
def pause(now: bool, at: float | None, cancel: bool, file: QueueFile, as_json: bool) -> None:
    """Pause after the run that goes on, at a time of day, or now."""
    if now + (at is not None) + cancel > 1:
        raise click.UsageError("--now, --at and --cancel exclude each other: give one of them")
    if not (at is not None or cancel) and file.find_runner() is None:
        raise FishdError("the queue does not run")
    with file.changing() as content:
        if cancel:
            content.cancel_pause()
        else:
            content.pause(time.time() if now else at)
    show_queue(file, as_json)


@queue.command()
@take_option
@_queue_options
def start(file: QueueFile, as_json: bool) -> int:
    """Run the experiments in order, until the queue is empty or pauses.

    Ctrl-C interrupts the run that goes on; the next start resumes it. Exit status 1 if an
    experiment has failed, or the fish has a fault.
    """
    from fishd.cli.queue_runner import QueueRunner

    status = QueueRunner(file, take=verb_lease().take, quiet=as_json).run()
    if as_json:
        print_json(file.view())
    return status
