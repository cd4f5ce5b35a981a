"""The verbs `fishctl swimmer wake` and `fishctl swimmer midlines`, which draw pictures."""

from pathlib import Path
from typing import Any

import click

from fishd.cli.options import F, FiniteRange, json_option, plot_option
from fishd.cli.output import echo, format_count, print_json, print_paths
from fishd.core import text
from fishd.recording.folder import check_new_files


def picture_options(function: F) -> F:
    """Add the argument SWIM, `--plot`, `--force` and `--json`."""
    decorators: tuple[Any, ...] = (
        json_option,
        click.option("--force", is_flag=True, help="Replace an existing file."),
        plot_option("it"),
        click.argument("file", metavar="SWIM", type=click.Path(path_type=Path, readable=False)),
    )
    for decorator in decorators:
        function = decorator(function)
    return function


def _picture_path(picture: Path | None, file: Path, what: str, force: bool) -> Path:
    """Return the file of a picture of a swim; raises `ParameterError` if it must not be written."""
    path = picture or file.with_name(f"{file.stem}-{what}.png")
    check_new_files([path], replace=force)
    return path


@click.command()
@click.option(
    "--settle",
    type=FiniteRange(min=0.0),
    default=4.0,
    show_default=True,
    help="Time before the first beat to use [s].",
)
@picture_options
def midlines(file: Path, settle: float, picture: Path | None, force: bool, as_json: bool) -> None:
    """Draw the midlines of a tail beat relative to the mean, and the amplitude along the body.

    SWIM is a file of 'fishctl simulate ... --to FILE.npz'. Without --plot, the picture is a .png
    file beside SWIM, named after it.
    """
    from fishd.lab.swimmer.midlines import compute_envelope, draw_midlines
    from fishd.virtual.swimmer import checkpoint

    path = _picture_path(picture, file, "midlines", force)
    time, lines = checkpoint.load(file).midlines.arrays()
    envelope = compute_envelope(time, lines.astype(float), settle)
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
@picture_options
def wake(file: Path, picture: Path | None, force: bool, as_json: bool) -> None:
    """Draw the vorticity of the water around the fish at the end of a swim, and the body in it.

    SWIM is a file of 'fishctl simulate ... --to FILE.npz'. Without --plot, the picture is a .png
    file beside SWIM, named after it.
    """
    from fishd.lab.swimmer import wake as water
    from fishd.virtual.swimmer import checkpoint

    path = _picture_path(picture, file, "vorticity", force)
    fish = water.restore_fish(checkpoint.load(file))
    scene = water.take_view(fish, water.window_around(fish.settings), water.COLUMNS)
    water.draw_wake(scene, water.choose_colour_limit(fish.settings), path)
    print_paths([path], as_json)
