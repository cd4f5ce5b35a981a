"""The verb that shows a camera's picture in the terminal, or writes it into a file."""

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fishd.cli.camera.options import camera_option, check_png, png_option
from fishd.cli.drawing import open_full_screen
from fishd.cli.output import echo
from fishd.core.errors import FishdError

if TYPE_CHECKING:
    from fishd.camera.axis import AxisWatch
    from fishd.camera.client import CameraClient
    from fishd.camera.drawing import Colours

AXIS_SEARCH_S = 8.0
"""Duration of the search for an axis [s]."""
REDRAW_INTERVAL_S = 0.2
"""Shortest time from one drawing to the next [s]."""


@click.command()
@camera_option
@png_option
@click.option("--follow", is_flag=True, help="Update picture, axis and numbers until Ctrl-C.")
@click.option("--axis", is_flag=True, help="Watch for some seconds to detect the axis.")
@click.option(
    "--whole", is_flag=True, help="Show the whole picture of the camera, not only the crop."
)
def view(address: str | None, png: Path | None, follow: bool, axis: bool, whole: bool) -> None:
    """Show the camera's picture in the terminal: what frames show, with the axis of motion.

    With --follow and --axis the axis of motion is drawn in, once the tail has moved for some
    seconds. If standard output is not a terminal, a line is printed instead; with --follow, one a
    second.
    """
    from fishd.camera.axis import AxisWatch
    from fishd.camera.client import CameraClient

    check_png(png)
    if png and follow:
        raise click.UsageError("--plot writes one picture, --follow shows all: one of the two")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # it too must restore the terminal
    with CameraClient(address, views=whole) as client:
        watch = AxisWatch()
        if follow:
            with suppress(KeyboardInterrupt):
                _follow(client, watch, whole)
            return
        _await_picture(client, watch, whole)
        if axis:
            _find_axis(client, watch)
        if png:
            _write_png(client, watch, whole, png)
        elif _can_draw():
            from rich.console import Console

            from fishd.cli.camera.terminal import TerminalPicture

            console = Console()
            console.print(TerminalPicture(_draw_picture(client, watch, whole)))
            echo(format_facts(client, watch))
        else:
            echo(format_facts(client, watch))


def format_facts(client: "CameraClient", watch: "AxisWatch") -> str:
    """Return the latest frame in one line: its number, age, rate, losses, and the axis."""
    assert client.latest
    header = client.latest.header
    parts = [f"frame {header.seq}"]
    if client.state.rate:
        parts.append(f"{client.state.rate:.1f} a second")
    parts.append(f"{(header.available - header.time) * 1e3:.0f} ms old when it came")
    if header.dropped or client.missed:
        parts.append(f"lost: {header.dropped + client.missed}")
    if watch.axis:
        parts.append(f"axis {watch.axis.offset:+.1f} px, {watch.axis.tilt * 57.29578:+.1f}°")
    return ", ".join(parts)


def _await_picture(client: "CameraClient", watch: "AxisWatch", whole: bool) -> None:
    """Wait for the first picture; raise `CameraLost`."""
    pictures = client.views() if whole else client.frames()
    next(pictures)
    while client.latest is None:
        _read_frames(client, watch, 0.1)
        client.check()


def _find_axis(client: "CameraClient", watch: "AxisWatch") -> None:
    """Watch for `AXIS_SEARCH_S`; raise `FishdError` if nothing moves."""
    _read_for(client, watch, AXIS_SEARCH_S)
    watch.find()
    if watch.axis is None:
        raise FishdError(
            "no axis was detected, as no tail moves: let the fish swim, or omit --axis"
        )


def _read_frames(client: "CameraClient", watch: "AxisWatch", seconds: float) -> None:
    for frame in client.poll(seconds):
        watch.add(frame)


def _follow(client: "CameraClient", watch: "AxisWatch", whole: bool) -> None:
    _await_picture(client, watch, whole)
    if not _can_draw():
        while True:
            echo(format_facts(client, watch))
            _read_for(client, watch, 1.0)
    from rich.console import Group
    from rich.text import Text

    from fishd.cli.camera.terminal import TerminalPicture

    with open_full_screen() as live:
        while True:
            drawing = TerminalPicture(_draw_picture(client, watch, whole))
            live.update(
                Group(drawing, Text(format_facts(client, watch), no_wrap=True)), refresh=True
            )
            _read_for(client, watch, REDRAW_INTERVAL_S)


def _read_for(client: "CameraClient", watch: "AxisWatch", seconds: float) -> None:
    """Read frames for some seconds; raise `CameraLost` if they have stopped."""
    end = time.monotonic() + seconds
    while (remaining := end - time.monotonic()) > 0.0:
        _read_frames(client, watch, remaining)
    client.check()
    if watch.due:
        watch.find()


def _draw_picture(client: "CameraClient", watch: "AxisWatch", whole: bool) -> "Colours":
    from fishd.camera import drawing

    assert client.latest
    pixels = client.latest.pixels
    if whole:
        if client.view is None:
            raise FishdError("the camera sends no views: publish.view_rate of its settings is 0")
        colours, crop = drawing.decode_view(client.view), client.view.header.crop
        return drawing.draw_axis(colours, watch.axis, len(pixels), crop)
    return drawing.draw_axis(drawing.to_colours(pixels), watch.axis, len(pixels))


def _write_png(client: "CameraClient", watch: "AxisWatch", whole: bool, png: Path) -> None:
    from fishd.camera import drawing

    colours = _draw_picture(client, watch, whole)
    drawing.write_png(png, colours if whole else drawing.enlarge(colours))
    echo(f"{png}: {format_facts(client, watch)}")


def _can_draw() -> bool:
    return sys.stdout.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
