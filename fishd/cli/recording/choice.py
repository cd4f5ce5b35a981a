"""Which recording a verb is about, and what its reader must know of it first."""

from pathlib import Path

import click

from fishd.cli.output import counted, echo
from fishd.recording import Run, open_run
from fishd.recording.folder import FOLDER_VARIABLE, find

folder_option = click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder with recordings, such as that of an experiment; default: "
    f"${FOLDER_VARIABLE}, else runs in the current folder.",
)


def opened(name: str, folder: Path | None) -> Run:
    """The recording that a name means; says on standard error where it is damaged.

    Raises `RecordingError`.
    """
    run = open_run(find(name, folder))
    if run.is_damaged:
        echo(f"fishctl: {run.path}: {damage(run.damaged, run.damage_reason)}", err=True)
    return run


def damage(ticks: int, reason: str = "") -> str:
    """Return what a damaged file has cost: `damaged: 10 ticks lost`, and why, where known."""
    return f"damaged: {counted(ticks, 'tick')} lost" + (f" ({reason})" if reason else "")
