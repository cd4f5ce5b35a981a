"""The verb that shows a fish live in the terminal: force, command, thrust and timing."""

import asyncio
import math
import os
import signal
import sys
import time
from collections.abc import Awaitable, Callable
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING

import click

from fishd.cli.options import daemon_options, for_option
from fishd.cli.output import echo, format_quantities, format_time_of_day, print_json_line
from fishd.cli.progress import open_full_screen
from fishd.client import AsyncFish
from fishd.core import text
from fishd.core.console import status_line

if TYPE_CHECKING:
    from fishd.camera.tail_watch import TailWatch

REDRAW_INTERVAL_S = 0.1
"""Shortest time from one drawing to the next [s]; a drawing shows all ticks since the last."""


@click.command()
@daemon_options
@for_option("End by itself after this time [s]; by default Ctrl-C ends it.")
@click.option(
    "--camera",
    is_flag=False,
    flag_value="",
    metavar="[ADDRESS]",
    help="Show the fin angle that a camera measures, too: that with the request address ADDRESS, "
    "else $FISHD_CAMERA, else that of this machine.",
)
def watch(endpoint: str | None, as_json: bool, seconds: float | None, camera: str | None) -> None:
    """Watch force, command and timing live, until Ctrl-C.

    'late' is the largest delay of a tick in the last 5 s, 'compute' the longest computing time.
    'skipped' counts the ticks that the daemon left out, 'lost' those that did not arrive here. If
    standard output is not a terminal, a line is printed every second instead; with --json, every
    tick as one line, and a line on standard error where ticks were lost.
    """
    can_draw = sys.stdout.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
    show = _print_ticks if as_json else _draw if can_draw else _print_lines
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # it too must restore the terminal
    with suppress(KeyboardInterrupt, TimeoutError), ExitStack() as stack:
        tail = None
        if camera is not None:
            from fishd.cli.camera.options import watch_tail

            tail = stack.enter_context(watch_tail(camera or None, endpoint))
        asyncio.run(_run(show, endpoint, seconds, tail))


async def _run(
    show: Callable[[AsyncFish, "TailWatch | None"], Awaitable[None]],
    endpoint: str | None,
    seconds: float | None,
    tail: "TailWatch | None",
) -> None:
    async with asyncio.timeout(seconds), AsyncFish(endpoint) as fish:
        await show(fish, tail)


async def _print_ticks(fish: AsyncFish, _: "TailWatch | None") -> None:
    seq = 0
    async for tick in fish.ticks():
        if 0 < seq < tick.seq - 1:
            lost = tick.seq - seq - 1
            echo(f"fishctl: just before tick {tick.seq}, ticks were lost: {lost}", err=True)
        seq = tick.seq
        print_json_line(tick)


async def _print_lines(fish: AsyncFish, tail: "TailWatch | None") -> None:
    while True:
        status = await fish.status()
        pairs = format_quantities(status.quantities, status.quantity_units)
        quantities = "".join(f"  {name} {value}" for name, value in pairs)
        echo(
            f"{format_time_of_day(status.t)}  {text.quoted(status.name)}  "
            f"{status_line(status)}{quantities}{f'  {tail.describe()}' if tail else ''}"
        )
        await asyncio.sleep(1.0)


async def _draw(fish: AsyncFish, tail: "TailWatch | None") -> None:
    from fishd.cli.watch_screen import View

    view = View(await fish.status(), tail)
    events = asyncio.create_task(view.collect(fish.events()))
    drawn = -math.inf
    try:
        with open_full_screen() as live:
            async for tick in fish.ticks():
                view.add(tick)
                # From the end of a drawing, so that ticks held up by a slow terminal are read.
                if time.monotonic() - drawn >= REDRAW_INTERVAL_S:
                    if view.outdated:
                        view.status = await fish.status()
                    live.update(view, refresh=True)
                    drawn = time.monotonic()
    finally:
        events.cancel()
