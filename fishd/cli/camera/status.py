"""The verb that shows the state of a camera."""

import datetime
from typing import TYPE_CHECKING

import click

from fishd.cli.camera.options import camera_option
from fishd.cli.options import json_option
from fishd.cli.output import echo_rows, format_count, make_printable, print_json

if TYPE_CHECKING:
    from fishd.camera.messages import CameraState


ANSWER_TIMEOUT_S = 2.0
"""Longest wait for an answer [s]."""


@click.command()
@camera_option
@json_option
def status(address: str | None, as_json: bool) -> None:
    """Show the state of the camera: since when, its rate, the age of frames, and losses."""
    import zmq

    from fishd.camera.requests import CameraRequests, find_camera

    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        requests = CameraRequests(address or find_camera(), context, ANSWER_TIMEOUT_S)
        state = requests.status()
    finally:
        context.destroy(linger=0)
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
    lost = []
    if state.dropped:
        lost.append(f"{format_count(state.dropped, 'frame')} that no client got")
    if state.broken:
        lost.append(f"{format_count(state.broken, 'frame')} that could not be decoded")
    if lost:
        pairs.append(("lost", " and ".join(lost)))
    pairs += [("degraded", line) for line in state.degraded]
    if state.virtual:
        until = "" if state.until is None else f", until {state.until:.3f} s"
        pairs.append(("clock", f"virtual, that of a fishd in lockstep{until}"))
    uptime = datetime.timedelta(seconds=int(state.uptime))
    pairs.append(("process", f"fishd-camera {state.version}, pid {state.pid}, up {uptime}"))
    pairs.append(("published", state.frames))
    return pairs
