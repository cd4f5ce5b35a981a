"""The verbs that show a camera: its state, and its picture in the terminal."""

import datetime
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.camera.options import camera_option, check_png, png_option
from fishd.cli.options import json_option
from fishd.cli.output import (
    echo,
    echo_rows,
    format_count,
    make_printable,
    print_json,
    print_json_line,
)
from fishd.cli.progress import open_full_screen
from fishd.core.errors import FishdError

if TYPE_CHECKING:
    from fishd.camera.axis import AxisWatch
    from fishd.camera.client import CameraClient
    from fishd.camera.drawing import Colours
    from fishd.camera.messages import CameraState

ANSWER_TIMEOUT_S = 2.0
"""Longest wait for an answer [s]."""
AXIS_SEARCH_S = 8.0
"""Duration of the search for an axis [s]."""
REDRAW_INTERVAL_S = 0.2
"""Shortest time from one drawing to the next [s]."""


@click.command()
@camera_option
@json_option
def status(address: str | None, as_json: bool) -> None:
    """Show the state of the camera and its beginning, the rate, the age of frames, and losses."""
    from fishd.camera.requests import CameraRequests, find_camera

    with CameraRequests(address or find_camera(), ANSWER_TIMEOUT_S) as requests:
        state = requests.status()
    if as_json:
        print_json(state)
    else:
        echo_rows(status_rows(make_printable(state)))


def status_rows(state: "CameraState") -> list[tuple[str, str]]:
    """Return names and values: those of the camera first, those of its process last."""
    ago = datetime.timedelta(seconds=int(max(0.0, state.t - state.since)))
    pairs = [("camera", state.device), ("state", f"{state.state} for {ago}")]
    if state.problem:
        pairs.append(("", state.problem))
    if state.remedy:
        pairs.append(("to do", state.remedy))
    if state.state == "streaming":
        pairs.append(("rate", f"{state.rate:.1f} frames a second"))
    if state.latency is not None:
        exposure = f", exposed for {state.exposure * 1e3:.1f} ms" if state.exposure else ""
        pairs.append(("age", f"{state.latency * 1e3:.1f} ms when available{exposure}"))
    picture_size = f"{state.picture_width} x {state.picture_height} px"
    source = f", of pictures of {picture_size}" if state.picture_width else ""
    pairs.append(("frames", f"{state.width} x {state.height} px{source}"))
    if state.tail != "off":
        pairs.append(("fin angle", _describe_tail(state)))
    if state.lens:
        pairs.append(("lens", state.lens))
    lost = []
    if state.dropped_frames:
        lost.append(f"{format_count(state.dropped_frames, 'frame')} that no client got")
    if state.broken_frames:
        lost.append(f"{format_count(state.broken_frames, 'frame')} that could not be decoded")
    if lost:
        pairs.append(("lost", " and ".join(lost)))
    pairs += [("limitation", line) for line in state.limitations]
    if state.virtual:
        until = "" if state.until is None else f", until {state.until:.3f} s"
        pairs.append(("clock", f"virtual, that of a fishd in lockstep{until}"))
    uptime = datetime.timedelta(seconds=int(state.uptime))
    pairs.append(("process", f"fishd-camera {state.version}, pid {state.pid}, up {uptime}"))
    pairs.append(("published", state.frames))
    return pairs


def _describe_tail(state: "CameraState") -> str:
    """Return what the camera does about the fin angle, and why it does no more."""
    if state.tail_problem:
        return f"{state.tail}: {state.tail_problem}"
    if state.tail == "measuring":
        measured = format_count(state.measured_pictures, "picture")
        left_out = state.unmeasured_pictures
        return f"measured in {measured}" + (f", no time for {left_out} more" if left_out else "")
    learn = "not learned: fishctl camera measure --learn"
    return learn if state.tail == "unlearned" else state.tail


@click.command()
@camera_option
@png_option
@click.option("--follow", is_flag=True, help="Update picture, axis and numbers until Ctrl-C.")
@click.option("--axis", is_flag=True, help="Watch for some seconds to detect the axis.")
@click.option(
    "--whole", is_flag=True, help="Show the whole picture of the camera, not only the crop."
)
@json_option
def view(
    address: str | None, png: Path | None, follow: bool, axis: bool, whole: bool, as_json: bool
) -> None:
    """Show the camera's picture in the terminal: what frames show, with the axis of motion.

    With --follow and --axis the axis of motion is drawn in, once the tail has moved for some
    seconds. If standard output is not a terminal, and with --json, a line is printed instead; with
    --follow, one a second.
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
                _follow(client, watch, whole, as_json)
            return
        _await_picture(client, watch, whole)
        if axis:
            _find_axis(client, watch)
        if png:
            _write_png(client, watch, whole, png)
        if as_json:
            print_json({"path": str(png) if png else None, **read_facts(client, watch)})
        elif png:
            echo(f"{png}: {format_facts(client, watch)}")
        elif _can_draw():
            from rich.console import Console

            from fishd.cli.camera.terminal import TerminalPicture

            console = Console()
            console.print(TerminalPicture(draw_picture(client, watch, whole)))
            echo(format_facts(client, watch))
        else:
            echo(format_facts(client, watch))


def read_facts(client: "CameraClient", watch: "AxisWatch") -> dict[str, Any]:
    """Return number, rate [Hz], age [s] and losses of the latest frame, and the axis [px, rad]."""
    assert client.latest
    header = client.latest.header
    return {
        "frame": header.seq,
        "rate": client.state.rate,
        "age": header.available - header.time,
        "lost": header.dropped_frames + client.missed,
        "axis": {"offset": watch.axis.offset, "tilt": watch.axis.tilt} if watch.axis else None,
    }


def format_facts(client: "CameraClient", watch: "AxisWatch") -> str:
    """Return the same facts in one line of text."""
    facts = read_facts(client, watch)
    parts = [f"frame {facts['frame']}"]
    if facts["rate"]:
        parts.append(f"{facts['rate']:.1f} a second")
    parts.append(f"{facts['age'] * 1e3:.0f} ms old when it came")
    if facts["lost"]:
        parts.append(f"lost: {facts['lost']}")
    if axis := facts["axis"]:
        parts.append(f"axis {axis['offset']:+.1f} px, {axis['tilt'] * 57.29578:+.1f}°")
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


def _follow(client: "CameraClient", watch: "AxisWatch", whole: bool, as_json: bool) -> None:
    _await_picture(client, watch, whole)
    if as_json or not _can_draw():
        while True:
            if as_json:
                print_json_line(read_facts(client, watch))
            else:
                echo(format_facts(client, watch))
            _read_for(client, watch, 1.0)
    from rich.console import Group
    from rich.text import Text

    from fishd.cli.camera.terminal import TerminalPicture

    with open_full_screen() as live:
        while True:
            drawing = TerminalPicture(draw_picture(client, watch, whole))
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


def draw_picture(client: "CameraClient", watch: "AxisWatch", whole: bool) -> "Colours":
    """Return the latest picture with the axis.

    whole: that of the camera, not only the crop
    """
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

    colours = draw_picture(client, watch, whole)
    drawing.write_png(png, colours if whole else drawing.enlarge(colours))


def _can_draw() -> bool:
    return sys.stdout.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
