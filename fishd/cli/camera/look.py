"""The verbs that show a camera: its state, and its picture."""

import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fishd.cli.camera.options import camera_option, check_png, png_option
from fishd.cli.options import json_option
from fishd.cli.output import echo, echo_rows, format_count, make_printable, print_json
from fishd.core.errors import FishdError

if TYPE_CHECKING:
    from fishd.camera.messages import CameraState

ANSWER_TIMEOUT_S = 2.0
"""Longest wait for an answer [s]."""


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
@png_option(required=True)
@click.option(
    "--whole", is_flag=True, help="Write the whole picture of the camera, not only the crop."
)
@json_option
def view(address: str | None, png: Path, whole: bool, as_json: bool) -> None:
    """Write the camera's picture into a file: what frames show.

    'fishctl camera page' shows it live, with the axis of motion, and 'fishctl camera align' finds
    the axis.
    """
    from fishd.camera import drawing
    from fishd.camera.client import CameraClient

    check_png(png)
    with CameraClient(address, views=whole) as client:
        next(client.views() if whole else client.frames())
        while client.latest is None:
            client.poll(0.1)
            client.check()
        header, pixels = client.latest.header, client.latest.pixels
        if whole and client.view is None:
            raise FishdError("the camera sends no views: publish.view_rate of its settings is 0")
        if client.view and whole:
            colours = drawing.decode_view(client.view)
            drawing.write_png(png, drawing.draw_crop(colours, client.view.header.crop))
        else:
            drawing.write_png(png, drawing.enlarge(drawing.to_colours(pixels)))
    age = header.available - header.time
    if as_json:
        print_json({"path": str(png), "frame": header.seq, "age": age})
    else:
        echo(f"{png}: frame {header.seq}, {age * 1e3:.0f} ms old when it came")
