"""The verb that shows the picture of a camera on a web page."""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

import click

from fishd.cli.camera.look import draw_picture, format_facts
from fishd.cli.camera.options import camera_option, follow_commands
from fishd.cli.options import endpoint_option, json_option
from fishd.cli.output import echo, print_json_line
from fishd.core.errors import FishError
from fishd.core.process.interruption import on_signal

if TYPE_CHECKING:
    from fishd.camera.axis import AxisWatch
    from fishd.camera.client import CameraClient
    from fishd.camera.messages import TailMessage
    from fishd.camera.tail_watch import TailWatch
    from fishd.window.camera_page.server import PageServer

DEFAULT_PORT = 9876
FACTS_PERIOD_S = 0.5
"""Time between two texts below the picture [s]."""
MIDLINE_TIMEOUT_S = 0.15
"""Longest wait of a picture for its midline [s]."""
MAX_READINGS = 64
"""Number of latest fin angles among which that of a picture is searched."""


@click.command()
@camera_option
@endpoint_option
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=DEFAULT_PORT,
    show_default=True,
    help="Port of the page; 0: any.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    metavar="ADDRESS",
    help="Address of the page. The default is for this machine only; with another one, every "
    "computer that reaches it can see the pictures.",
)
@json_option
def page(address: str | None, endpoint: str | None, port: int, host: str, as_json: bool) -> None:
    """Show what the camera sees on a web page, live, with the axis of motion, until Ctrl-C.

    Once the camera has learned the tail, the page shows its midline and the fin angle, and with a
    running fishd the lag behind the instruction angle. It needs nothing from the internet, and
    accepts no request that changes anything.
    """
    from fishd.camera.client import CameraClient
    from fishd.camera.tail_watch import TailWatch
    from fishd.window.camera_page.server import PageServer

    tail = TailWatch()
    with (
        suppress(KeyboardInterrupt),
        CameraClient(address, views=True, tail=True) as client,
        follow_commands(endpoint, client.state.boot_id, tail),
    ):
        asyncio.run(_serve(client, tail, PageServer(host, port), as_json))


async def _serve(
    client: "CameraClient", tail: "TailWatch", server: "PageServer", as_json: bool
) -> None:
    loop, stopping = asyncio.get_running_loop(), threading.Event()
    async with server:

        def tell(message: str | bytes) -> None:
            loop.call_soon_threadsafe(server.show, message)

        with on_signal(stopping.set):
            if as_json:
                print_json_line({"url": server.url})
            else:
                echo(f"the camera is at {server.url}; Ctrl-C ends it")
            await asyncio.to_thread(_follow, client, tail, tell, stopping)


def _follow(
    client: "CameraClient",
    tail: "TailWatch",
    tell: Callable[[str | bytes], None],
    stopping: threading.Event,
) -> None:
    """Give each new picture, and texts about the camera, to `tell`."""
    from fishd.camera import drawing
    from fishd.camera.axis import AxisWatch

    watch, view, is_shown, next_facts, deadline = AxisWatch(), None, True, 0.0, 0.0
    readings: deque[TailMessage] = deque(maxlen=MAX_READINGS)
    while not stopping.is_set():
        for frame in client.poll(0.1):
            watch.add(frame)
        for reading in client.take_tails():
            tail.add(reading)
            readings.append(reading)
        if watch.due:
            watch.find()
        now = time.monotonic()
        if client.latest and client.view is not view:
            view, is_shown = client.view, False
            deadline = now + (MIDLINE_TIMEOUT_S if client.state.tail == "measuring" else 0.0)
        if view and not is_shown:
            same = next((r for r in readings if r.seq == view.header.seq), None)
            if same or now >= deadline:
                is_shown = True
                tell(drawing.encode_jpeg(draw_picture(client, watch, True, same)))
        if now >= next_facts:
            tell(_describe(client, watch, tail))
            next_facts = now + FACTS_PERIOD_S


def _describe(client: "CameraClient", watch: "AxisWatch", tail: "TailWatch") -> str:
    """Return lines about the camera and its latest frame."""
    try:
        client.check()
    except FishError as error:
        return f"lost: {error}"
    state = client.state
    lines = [f"{state.state}: {state.device}", state.problem, state.remedy]
    if client.latest:
        lines.append(format_facts(client, watch))
    if tail.latest:
        lines.append(tail.describe())
    if watch.axis is None:
        lines.append("the axis is not known yet: the tail must move for some seconds")
    return "\n".join(filter(None, lines))
