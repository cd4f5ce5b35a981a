"""The verbs below `fishctl runs`: note, rename, delete and its undo, results, and a zip file."""

import sys
from contextlib import ExitStack
from pathlib import Path

import click

from fishd.cli.options import F, Utf8Text, json_option
from fishd.cli.output import echo, echo_table, format_count, print_json, print_paths
from fishd.cli.progress import format_estimate
from fishd.cli.recording.files import folder_option
from fishd.core import text
from fishd.core.errors import RecordingError
from fishd.core.experiments import Estimate
from fishd.core.files import os_errors
from fishd.recording import stored_runs


def _options(function: F) -> F:
    """Add `--folder` and `--json`."""
    return folder_option(json_option(function))


@click.command()
@click.argument("run")
@click.argument("note", type=Utf8Text())
@_options
def note(run: str, note: str, folder: Path, as_json: bool) -> None:
    """Replace the note of a run by NOTE.

    It is in a text file beside a recording, which itself stays unchanged, or in the folder of an
    experiment. All verbs, tables and figures use it.
    """
    path = stored_runs.find_stored_run(run, folder)
    stored_runs.set_note(path, note)
    print_paths([path], as_json)


@click.command()
@click.argument("run")
@click.argument("name", type=Utf8Text())
@_options
def rename(run: str, name: str, folder: Path, as_json: bool) -> None:
    """Rename a run that is not in progress to NAME."""
    path = stored_runs.find_stored_run(run, folder)
    print_paths([stored_runs.rename_run(path, name)], as_json)


@click.command()
@click.argument("runs", nargs=-1, required=True)
@_options
def delete(runs: tuple[str, ...], folder: Path, as_json: bool) -> None:
    """Move runs into the trash, where they are kept for 30 days.

    'fishctl runs restore' brings them back; until then they take space on the disk.
    """
    paths = [stored_runs.find_stored_run(run, folder) for run in runs]
    deleted = list(map(stored_runs.delete_run, paths))
    if as_json:
        print_json(deleted)
    for run in () if as_json else deleted:
        echo(f"{run.name} is in the trash; to undo: fishctl runs restore {run.id}")


@click.command()
@click.argument("ids", nargs=-1, metavar="[ID]...")
@click.option("--empty", is_flag=True, help="Remove all that is in the trash, or each ID.")
@_options
def trash(ids: tuple[str, ...], empty: bool, folder: Path, as_json: bool) -> None:
    """List the deleted runs, the latest first, or remove them.

    ID is the first word of a line of this list.
    """
    if ids and not empty:
        raise click.UsageError("an ID goes with --empty")
    if empty:
        count = stored_runs.empty_trash(folder, ids=ids)
        echo(f"{format_count(count, 'run')} removed", err=as_json)
    deleted = stored_runs.list_trash(folder)
    if as_json:
        print_json(deleted)
    for run in () if as_json else deleted:
        echo(f"{run.id}  {run.name}")


@click.command()
@click.argument("run")
@_options
def restore(run: str, folder: Path, as_json: bool) -> None:
    """Bring a run back from the trash.

    RUN is its name, or its line in 'fishctl runs trash'.
    """
    print_paths([stored_runs.restore_run(run, folder)], as_json)


@click.command(name="zip")
@click.argument("run")
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="File to write, or - for the standard output. [default: RUN.zip in this folder]",
)
@folder_option
def pack(run: str, target: Path | None, folder: Path) -> None:
    """Write all files of a run into one zip file."""
    path = stored_runs.find_stored_run(run, folder)
    target = target or Path(f"{run}.zip")
    if str(target) == "-":
        stored_runs.pack_run(path, sys.stdout.buffer)
        return
    if path.resolve() in target.resolve().parents:
        raise RecordingError(f"{target} would contain itself: write it outside of {path}")
    problem, remedy = f"{target} cannot be written", "give another file with --to"
    with os_errors(RecordingError, problem, remedy), ExitStack() as stack:
        with target.open("xb") as file:
            stack.callback(target.unlink)
            stored_runs.pack_run(path, file)
        stack.pop_all()
    echo(target)


@click.command()
@click.argument("runs", nargs=-1, required=True)
@_options
def show(runs: tuple[str, ...], folder: Path, as_json: bool) -> None:
    """Show the results of runs side by side.

    Intervals are 95 % confidence intervals. A search shows its answer, not the luckiest of its
    candidates. 'fishctl plot RUN RUN' draws recordings over each other.
    """
    from rich.table import Table

    from fishd.lab.run_results import QUANTITIES, read_results

    results = [read_results(stored_runs.find_stored_run(run, folder)) for run in runs]
    if as_json:
        print_json(results)
        return
    rows = [(result, row) for result in results for row in result.rows]
    names = [name for name in QUANTITIES if any(name in row.values for _, row in rows)]
    table = Table(box=None, pad_edge=False)
    for head in ("run", "controller"):
        table.add_column(head, overflow="fold")
    for name in names:
        unit = QUANTITIES[name].unit
        table.add_column(f"{name}{f' [{unit}]' if unit else ''}", justify="right", no_wrap=True)
    for result, row in rows:
        unit = result.force_unit
        cells = [QUANTITIES[name].format(row.values.get(name), unit) for name in names]
        table.add_row(text.line(result.name), text.line(row.label), *cells)
    echo_table(table)
    for result in results:
        for estimate in result.estimates:
            echo(f"{result.name}: {format_estimate(Estimate(*estimate))}")
        if result.summary:
            echo(f"{result.name}: {result.summary}")


VERBS: tuple[click.Command, ...] = (show, note, rename, delete, trash, restore, pack)
