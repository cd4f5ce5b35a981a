"""The verb that shows what a camera says of itself."""

import datetime
from typing import TYPE_CHECKING

import click

from fishd.cli.camera.options import camera_option
from fishd.cli.options import json_option
from fishd.cli.output import counted, echo_rows, made_printable, print_json

if TYPE_CHECKING:
    from fishd.camera.messages import CameraState


TIMEOUT = 2.0
"""How long to wait for an answer [s]."""


@click.command()
@camera_option
@json_option
def status(address: str | None, as_json: bool) -> None:
    """Show what the camera says of itself: its state and since when, rate, age and losses."""
    import zmq

    from fishd.camera.requests import CameraRequests, find_camera

    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        requests = CameraRequests(address or find_camera(), context, TIMEOUT)
        found = requests.status()
    finally:
        context.destroy(linger=0)
    if as_json:
        print_json(found)
    else:
        echo_rows(rows(made_printable(found)))


def rows(state: "CameraState") -> list[tuple[str, str]]:
    """The camera first, its process last."""
    ago = datetime.timedelta(seconds=int(max(0.0, state.t - state.since)))
    found = [("camera", state.device), ("state", f"{state.state} for {ago}")]
    if state.problem:
        found.append(("", state.problem))
    if state.remedy:
        found.append(("to do", state.remedy))
    if state.state == "streaming":
        found.append(("rate", f"{state.rate:.1f} frames a second"))
    if state.latency is not None:
        exposure = f", exposed for {state.exposure * 1e3:.1f} ms" if state.exposure else ""
        found.append(("age", f"{state.latency * 1e3:.1f} ms when it can be had{exposure}"))
    whole = f"{state.picture_width} x {state.picture_height} px"
    of = f", of pictures of {whole}" if state.picture_width else ""
    found.append(("frames", f"{state.width} x {state.height} px{of}"))
    lost = []
    if state.dropped:
        lost.append(f"{counted(state.dropped, 'frame')} that nobody got")
    if state.broken:
        lost.append(f"{counted(state.broken, 'frame')} that could not be decoded")
    if lost:
        found.append(("lost", " and ".join(lost)))
    found += [("degraded", line) for line in state.degraded]
    if state.virtual:
        until = "" if state.until is None else f", until {state.until:.3f} s"
        found.append(("clock", f"virtual, that of a fishd in lockstep{until}"))
    uptime = datetime.timedelta(seconds=int(state.uptime))
    found.append(("process", f"fishd-camera {state.version}, pid {state.pid}, up {uptime}"))
    found.append(("published", state.frames))
    return found
