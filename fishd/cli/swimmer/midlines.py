"""The verb `fishctl swimmer midlines`, which draws the motion of the body in a tail beat."""

from pathlib import Path

import click

from fishd.cli.options import FiniteRange, json_option
from fishd.cli.output import echo, format_count, print_json
from fishd.cli.swimmer.options import picture_options
from fishd.core import text
from fishd.lab.swimmer import midline_figure
from fishd.lab.swimmer.envelope import compute_envelope
from fishd.lab.swimmer.files import read_midlines
from fishd.recording.folder import check_new_files


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
    midline_figure.draw_midlines(envelope, f"{title}{frequency:.2f} Hz".replace("$", r"\$"), path)
    tail = float(envelope.amplitudes[:, -1].mean())
    if as_json:
        gait = {"beats": beats, "frequency": frequency, "tail": tail}
        print_json({"path": path, **gait})
        return
    echo(path)
    echo(f"{format_count(beats, 'beat')} of {frequency:.3f} Hz, tail ±{tail:.3f} lengths")
