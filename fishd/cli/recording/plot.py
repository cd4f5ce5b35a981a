"""The verb that draws a recording."""

import math
from pathlib import Path

import click

from fishd.cli.options import FiniteRange, json_option
from fishd.cli.output import print_paths
from fishd.cli.recording.choice import folder_option, open_recording
from fishd.lab.run_figure import draw_run
from fishd.lab.run_traces import traces
from fishd.recording.folder import check_new_files


@click.command()
@click.argument("run")
@click.option(
    "--from", "begin", type=FiniteRange(min=0), default=0.0, help="Begin at this time [s]."
)
@click.option(
    "--until", "end", type=FiniteRange(min=0), help="End at this time [s]; default: the end."
)
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    default=Path(),
    help="Folder to write to; default: this one.",
)
@click.option("--png", "only", flag_value="png", help="Draw only the picture.")
@click.option("--html", "only", flag_value="html", help="Draw only the interactive page.")
@click.option("--force", is_flag=True, help="Replace existing files.")
@folder_option
@json_option
def plot(
    run: str,
    begin: float,
    end: float | None,
    target: Path,
    only: str | None,
    force: bool,
    folder: Path | None,
    as_json: bool,
) -> None:
    """Draw forces, command, thrust, the controller's own quantities, and a phase portrait.

    RUN is a path, a name in the folder of recordings, or 'latest'. NAME.png is a picture; NAME.html
    is a page to zoom into, which needs no network.
    """
    recorded = open_recording(run, folder)
    run_traces = traces(recorded, begin, math.inf if end is None else end)
    forms = [only] if only else ["png", "html"]
    paths = {form: target / f"{recorded.name}.{form}" for form in forms}
    check_new_files(paths.values(), replace=force)
    if "png" in paths:
        draw_run(run_traces, paths["png"])
    if "html" in paths:
        from fishd.lab.run_page import write_page

        write_page(run_traces, paths["html"])
    print_paths(paths.values(), as_json)
