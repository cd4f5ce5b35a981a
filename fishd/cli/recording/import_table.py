"""The verb that makes a recording of a table of another rig."""

from pathlib import Path

import click
from msgspec.structs import asdict

from fishd.cli.options import FiniteRange, Utf8Text, json_option
from fishd.cli.output import echo, format_count, print_json
from fishd.cli.recording.files import folder_option
from fishd.core import text
from fishd.core.errors import RecordingError
from fishd.recording import RunWriter
from fishd.recording.folder import recording_path


@click.command(name="import")
@click.argument("file", type=click.Path(path_type=Path))
@click.argument("run", required=False)
@click.option(
    "--columns",
    metavar="NAME,...",
    help="Names of all columns in order, with their units, such as time_s,fx_mN,fy_mN,phi_c_deg; "
    "- leaves one out. [default: the first line of FILE]",
)
@click.option(
    "--rate",
    type=FiniteRange(min=0.01, max=1e5),
    metavar="HZ",
    help="Rows per second. [default: from the column time]",
)
@click.option(
    "--samples",
    type=click.IntRange(1, 10**6),
    default=1,
    show_default=True,
    help="Samples of the force sensor since the row before whose mean is in each row.",
)
@folder_option
@click.option("--subject", type=Utf8Text(), default="", help="Name or number of the fish.")
@click.option("--note", type=Utf8Text(), default="", help="Purpose of the recording.")
@json_option
def import_table(
    file: Path,
    run: str | None,
    columns: str | None,
    rate: float | None,
    samples: int,
    folder: Path,
    subject: str,
    note: str,
    as_json: bool,
) -> None:
    """Make a recording of a table of another rig, so that runs, plot and identify work on it.

    FILE is a text file: CSV, or columns separated by semicolons, tabs or spaces, with decimal
    points or commas. RUN is the name of the recording, or a path; by default that of FILE.

    \b
    time    s, ms, us    of the row; optional with --rate
    fx, fy  N, mN, g     force on the fish, thrust positive, and lateral force
    phi_c   rad, deg     angle that was commanded to the servo
    alpha   rad, deg     true angle of the fin
    power   W, mW        electrical power of the servo

    One besides time is enough; identify needs fx, fy and phi_c. A column of another name is kept
    as a quantity. A row in which a number is missing is a gap.
    """
    from fishd.lab.foreign_table import UNITS, make_ticks, read_table

    table = read_table(file, columns.split(",") if columns is not None else None)
    try:
        ticks = make_ticks(table, rate, samples)
    except RecordingError as error:
        raise RecordingError(f"{file}: {error}") from None
    path = recording_path(run or file.stem, folder)
    with RunWriter(path, source="import", subject=subject, note=note or file.name) as writer:
        for tick in ticks:
            writer.tick(tick)
    summary = writer.summary
    if as_json:
        print_json({"path": str(writer.path), "columns": list(table), **asdict(summary)})
    else:
        echo(
            f"{writer.path}: {summary.duration:.1f} s, {format_count(summary.ticks, 'tick')}, "
            f"{summary.lost_ticks} lost: {', '.join(map(text.quoted, table))}"
        )
    rows = len(next(iter(table.values())))
    if rows > len(ticks):
        left_out = format_count(rows - len(ticks), "row")
        echo(f"fishctl: {file}: {left_out} left out, in which a number is missing", err=True)
    missing = [name for name in ("fx", "fy", "phi_c") if name not in table]
    if missing:
        echo(f"fishctl: {file}: without {', '.join(missing)}: identify cannot use it", err=True)
    unknown = [text.quoted(name) for name in table if name not in UNITS]
    if unknown:
        echo(f"fishctl: {file}: kept as quantities: {', '.join(unknown)}", err=True)
