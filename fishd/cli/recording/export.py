"""The verb that writes a recording as tables for other programs."""

from pathlib import Path

import click

from fishd.cli.options import json_option
from fishd.cli.output import print_paths
from fishd.cli.recording.choice import folder_option, open_recording
from fishd.recording.export import Format
from fishd.recording.export import export as write


@click.command()
@click.argument("run")
@click.option("--csv", "form", flag_value="csv", help="Write text, which every program reads.")
@click.option(
    "--parquet",
    "form",
    flag_value="parquet",
    help="Write Parquet, which is smaller and faster to read.",
)
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path(),
    help="Folder to write to; default: this one.",
)
@click.option("--force", is_flag=True, help="Replace existing files.")
@folder_option
@json_option
def export(
    run: str,
    form: Format | None,
    target: Path,
    force: bool,
    folder: Path | None,
    as_json: bool,
) -> None:
    """Write a recording as tables: one row a tick, and a second file with its events.

    RUN is a path, a name in the folder of recordings, or 'latest'. All digits of a number are kept.
    """
    if form is None:
        raise click.UsageError("--csv or --parquet is needed")
    print_paths(write(open_recording(run, folder), target, form, replace=force), as_json)
