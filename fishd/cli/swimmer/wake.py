"""The verb `fishctl swimmer wake`, which draws the water around a free swimmer."""

from pathlib import Path

import click

from fishd.cli.options import FiniteRange, json_option
from fishd.cli.output import print_paths
from fishd.cli.swimmer.options import picture_options
from fishd.lab.swimmer import view, wake_figure
from fishd.lab.swimmer.files import restore_fish
from fishd.recording.folder import check_new_files
from fishd.virtual.swimmer import checkpoint


@click.command()
@click.argument("file", metavar="CHECKPOINT", type=click.Path(path_type=Path, readable=False))
@click.option(
    "--field",
    "fields",
    type=click.Choice(view.QUANTITIES),
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
    fields: tuple[view.Quantity, ...],
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
    fish = restore_fish(checkpoint.load(file))
    window = (view.whole_window if whole else view.window_around)(fish.settings)
    for field, path in paths.items():
        scene = view.take_view(fish, field, window, wake_figure.COLUMNS)
        wake_figure.draw_wake(scene, limit or view.choose_colour_limit(fish.settings, field), path)
    print_paths(paths.values(), as_json)
