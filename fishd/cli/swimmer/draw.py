"""The verbs `fishctl swimmer wake` and `fishctl swimmer midlines`, which draw pictures."""

from pathlib import Path
from typing import Any

import click

from fishd.cli.options import F, FiniteRange, json_option
from fishd.cli.output import echo, format_count, print_json, print_paths
from fishd.core import text
from fishd.lab.swimmer import wake as water
from fishd.lab.swimmer.midlines import compute_envelope, draw_midlines, read_midlines
from fishd.recording.folder import check_new_files
from fishd.virtual.swimmer import checkpoint


def picture_options(function: F) -> F:
    """Add `--to`, `--form` and `--force`."""
    decorators: tuple[Any, ...] = (
        click.option("--force", is_flag=True, help="Replace existing files."),
        click.option(
            "--form",
            type=click.Choice(["png", "svg", "pdf"]),
            default="png",
            show_default=True,
            help="Format of the pictures.",
        ),
        click.option(
            "--to",
            "target",
            type=click.Path(path_type=Path, file_okay=False, exists=True),
            default=Path(),
            help="The folder to write to. [default: the current folder]",
        ),
    )
    for decorator in decorators:
        function = decorator(function)
    return function


@click.command()
@click.argument("file", metavar="SWIM", type=click.Path(path_type=Path, readable=False))
@click.option(
    "--settle",
    type=FiniteRange(min=0.0),
    default=4.0,
    show_default=True,
    help="Time before the first beat to use [s].",
)
@picture_options
@json_option
def midlines(
    file: Path, settle: float, target: Path, form: str, force: bool, as_json: bool
) -> None:
    """Draw the midlines of a tail beat relative to the mean, and the amplitude along the body.

    SWIM is a file of 'fishctl simulate ... --save FILE.npz'. The picture is named after it:
    FILE-midlines.png.
    """
    path = target / f"{file.stem}-midlines.{form}"
    check_new_files([path], replace=force)
    envelope = compute_envelope(*read_midlines(file), settle)
    beats = len(envelope.periods)
    frequency = beats / float(envelope.periods.sum())
    title = f"{text.line(file.stem)}: midlines of the last of {format_count(beats, 'beat')}, "
    draw_midlines(envelope, f"{title}{frequency:.2f} Hz".replace("$", r"\$"), path)
    tail = float(envelope.amplitudes[:, -1].mean())
    if as_json:
        gait = {"beats": beats, "frequency": frequency, "tail": tail}
        print_json({"path": path, **gait})
        return
    echo(path)
    echo(f"{format_count(beats, 'beat')} of {frequency:.3f} Hz, tail ±{tail:.3f} lengths")


@click.command()
@click.argument("file", metavar="CHECKPOINT", type=click.Path(path_type=Path, readable=False))
@click.option(
    "--field",
    "fields",
    type=click.Choice(water.QUANTITIES),
    multiple=True,
    default=("vorticity", "speed"),
    show_default=True,
    help="Quantity to draw. Repeatable.",
)
@click.option(
    "--whole", is_flag=True, help="Draw the whole tank, not only the fish and its near wake."
)
@click.option(
    "--limit",
    type=FiniteRange(min=0.0, min_open=True),
    help="Value at which the colours end, in the unit of the field. [default: the same for all "
    "pictures of such a fish]",
)
@picture_options
@json_option
def wake(
    file: Path,
    fields: tuple[water.Quantity, ...],
    whole: bool,
    limit: float | None,
    target: Path,
    form: str,
    force: bool,
    as_json: bool,
) -> None:
    """Draw vorticity and speed of the water, and the body in it.

    CHECKPOINT is a file of 'fishctl simulate ... --checkpoint FILE'. The pictures are named after
    it: FILE-vorticity.png.
    """
    fields = tuple(dict.fromkeys(fields))
    if limit is not None and len(fields) > 1:
        raise click.UsageError(
            "--limit applies to one field, and there are several: give one --field"
        )
    paths = {field: target / f"{file.stem}-{field}.{form}" for field in fields}
    check_new_files(paths.values(), replace=force)
    fish = water.restore_fish(checkpoint.load(file))
    window = (water.whole_window if whole else water.window_around)(fish.settings)
    for field, path in paths.items():
        scene = water.take_view(fish, field, window, water.COLUMNS)
        water.draw_wake(scene, limit or water.choose_colour_limit(fish.settings, field), path)
    print_paths(paths.values(), as_json)
