"""Choice of the recording that a verb reads, with a warning about damage."""

from pathlib import Path

import click

from fishd.cli.output import echo, format_count
from fishd.recording import Run, open_run
from fishd.recording.folder import FOLDER_VARIABLE, find_recording

folder_option = click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder with recordings, such as that of an experiment; default: "
    f"${FOLDER_VARIABLE}, else runs in the current folder.",
)


def open_recording(name: str, folder: Path | None) -> Run:
    """Open the recording of a name; print on standard error if it is damaged.

    Raises `RecordingError`.
    """
    run = open_run(find_recording(name, folder))
    if run.is_damaged:
        echo(f"fishctl: {run.path}: {format_damage(run.damaged, run.damage_reason)}", err=True)
    return run


def format_damage(ticks: int, reason: str = "") -> str:
    """Return the loss of a damaged file, `damaged: 10 ticks lost`, with the reason if known."""
    return f"damaged: {format_count(ticks, 'tick')} lost" + (f" ({reason})" if reason else "")
