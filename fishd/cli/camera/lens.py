"""The verb that calibrates the lens of a camera, and its view of the plane of the tail."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fishd.cli.camera.options import camera_option
from fishd.cli.options import FiniteRange, json_option
from fishd.cli.output import echo, echo_rows, print_json
from fishd.cli.progress import show_progress
from fishd.core import files, text
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError
from fishd.core.process.interruption import raise_on_first_signal

if TYPE_CHECKING:
    from fishd.camera.tail.lens import Lens, Turn
    from fishd.core.camera_frames import Pixels

MIN_VIEW_RATE_HZ = 2.0
"""Fewest views a second that show whether the board is still."""
_file = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("paths", nargs=-1, type=_file, metavar="[FILE]...")
@camera_option
@click.option("--board", type=_file, metavar="FILE", help="Write the board into this file (.svg).")
@click.option(
    "--plane", is_flag=True, help="The board lies flat at the depth of the tail, after the lens."
)
@click.option(
    "--square",
    "square_mm",
    type=FiniteRange(min=1.0, max=1000.0),
    metavar="MM",
    help="Side of a square: of --board [default: 28], or, with --plane, as measured on the print, "
    "for places in millimetres.",
)
@click.option("--to", "target", type=_file, metavar="FILE", help="With FILEs: the calibration.")
@click.option(
    "--rotate",
    "turn",
    type=click.Choice([0, 90, 180, 270]),
    help="With FILEs: clockwise turn after which the head is at the left [degrees].",
)
@json_option
def lens(
    paths: tuple[Path, ...],
    address: str | None,
    board: Path | None,
    plane: bool,
    square_mm: float | None,
    target: Path | None,
    turn: "Turn | None",
    as_json: bool,
) -> int:
    """Calibrate the lens of the camera with a printed board, then its view with --plane.

    Print the board of --board, and glue it onto something flat. Hold it before the camera in all
    parts of the picture, slanted to all sides; the pictures are taken by themselves. Then lay it
    flat at the depth of the tail, and give the same command with --plane. Fin angles of a tail that
    is learned afterwards are those in this plane.

    From FILEs, pictures or videos of the board, the calibration is written to --to, for 'fishctl
    camera measure VIDEO --lens'; there, too, --plane completes it.
    """
    if board:
        return _write_board(board, square_mm)
    if square_mm and not plane:
        raise click.UsageError("--square is for --board and --plane")
    if bool(paths) != bool(target):
        raise click.UsageError("--to FILE is needed with FILEs, and only with them")
    if (address and paths) or (turn is not None and not paths):
        raise click.UsageError("--camera is not for FILEs, and --rotate is only for them")
    try:
        with raise_on_first_signal():
            if target:
                result = _calibrate_from_files(paths, target, turn, plane, square_mm)
            else:
                result = _calibrate_live(address, plane, square_mm)
    except KeyboardInterrupt:
        echo("fishctl: interrupted: nothing is calibrated", err=True)
        return INTERRUPTED
    if as_json:
        print_json(result)
        return 0
    echo_rows([("lens", result.describe())])
    if not plane:
        echo("lay the board flat at the depth of the tail, and give the same command with --plane")
    else:
        measure = f"VIDEO --lens {target}" if target else "--learn"
        echo(f"learn the tail with this calibration: fishctl camera measure {measure}")
    return 0


def _write_board(path: Path, square_mm: float | None) -> int:
    from fishd.camera.tail.board import COLUMNS, SQUARE_MM, draw_svg

    if path.suffix.lower() != ".svg":
        raise click.UsageError(
            f"'{path}' is not valid for --board: a name ending in .svg is needed"
        )
    side = square_mm or SQUARE_MM
    try:
        files.write_atomically(path, draw_svg(side), new=True)
    except OSError as error:
        raise FishdError(f"{path} cannot be written: {error.strerror or error}") from None
    echo(f"{path}: print it at 100 %; {COLUMNS} squares are {COLUMNS * side:g} mm")
    return 0


def _calibrate_live(address: str | None, plane: bool, square_mm: float | None) -> "Lens":
    """Calibrate with the pictures of a camera until they are sufficient, and store the result."""
    from fishd.camera.client import CameraClient
    from fishd.camera.drawing import decode_view
    from fishd.camera.tail.board import MIN_VIEWS, BoardWatch, find_plane
    from fishd.camera.tail.learner import CannotLearn

    with CameraClient(address, views=True) as client:
        settings = client.settings()
        if settings.publish.view_rate < MIN_VIEW_RATE_HZ:
            raise FishdError(f"set publish.view_rate of the camera to {MIN_VIEW_RATE_HZ:g} or more")
        views = client.views()
        next(views)
        state, turn = client.status(), settings.picture.rotate
        size = state.picture_width, state.picture_height
        watch = BoardWatch(turn, size)
        calibrate = watch.calibrate
        if plane:
            lens = client.requests.lens()
            lens.check(size, turn)
            calibrate = partial(find_plane, lens, watch, square_mm)
        with show_progress(1 if plane else MIN_VIEWS, "views", err=True) as bar:
            for view in views:
                if watch.add(view.header.time, decode_view(view)[..., 0]):
                    try:
                        result = calibrate()
                    except CannotLearn as missing:
                        bar.done(f"fishctl: {missing}", len(watch.views))
                    else:
                        client.requests.set_lens(result)
                        return result
                bar.at(len(watch.views), watch.problem)
    raise AssertionError("views never end")


def _calibrate_from_files(
    paths: tuple[Path, ...],
    target: Path,
    turn: "Turn | None",
    plane: bool,
    square_mm: float | None,
) -> "Lens":
    from fishd.camera.tail.board import BoardWatch, find_plane
    from fishd.camera.tail.lens import Lens

    lens = Lens.load(target) if plane else None
    if lens:
        turn = lens.rotate if turn is None else turn
        lens.check(lens.size, turn)
    elif target.exists():
        raise FishdError(f"{target} exists already: give another file with --to")
    try:
        files.check_writable(target)
    except files.FileProblem as problem:
        raise FishdError(f"{target}: {problem}") from None
    watch = BoardWatch(turn or 0)
    with show_progress(len(paths), "files", err=True) as bar:
        for number, path in enumerate(paths):
            before = len(watch.views)
            for moment, pixels in _read_pictures(path, turn or 0):
                watch.add(moment, pixels)
            if len(watch.views) == before:
                bar.warn(f"fishctl: {text.quoted(str(path))}: {watch.problem}")
            bar.at(number + 1)
    result = find_plane(lens, watch, square_mm) if lens else watch.calibrate()
    result.save(target, new=not plane)
    return result


def _read_pictures(path: Path, turn: "Turn") -> "Iterator[tuple[float | None, Pixels]]":
    """Yield the turned pictures of a file and their times [s]; a single one has none."""
    from fishd.camera.picture import read_picture, rotate
    from fishd.camera.video import Video

    picture = read_picture(path)
    if picture is not None:
        yield None, rotate(picture, turn)
        return
    with Video(path, None, turn) as video:
        for each in video.pictures():
            yield each.time, each.pixels
