"""The verb that shows a fish live in the terminal: force, command, thrust and timing."""

import asyncio
import math
import os
import signal
import sys
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress

import click

from fishd.cli.options import daemon_options, for_option
from fishd.cli.output import echo, format_quantities, format_time_of_day, print_json_line
from fishd.cli.progress import open_full_screen
from fishd.client import AsyncFish
from fishd.core import text
from fishd.core.console import status_line

REDRAW_INTERVAL_S = 0.1
"""Shortest time from one drawing to the next [s]; a drawing shows all ticks since the last."""


@click.command()
@daemon_options
@for_option("End by itself after this time [s]; by default Ctrl-C ends it.")
def watch(endpoint: str | None, as_json: bool, seconds: float | None) -> None:
    """Watch force, command and timing live, until Ctrl-C.

    'late' is the largest delay of a tick in the last 5 s, 'compute' the longest computing time.
    'skipped' counts the ticks that the daemon left out, 'lost' those that did not arrive here. If
    standard output is not a terminal, a line is printed every second instead; with --json, every
    tick as one line, and a line on standard error where ticks were lost.
    """
    can_draw = sys.stdout.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
    show = _print_ticks if as_json else _draw if can_draw else _print_lines
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # it too must restore the terminal
    with suppress(KeyboardInterrupt, TimeoutError):
        asyncio.run(_run(show, endpoint, seconds))


async def _run(
    show: Callable[[AsyncFish], Awaitable[None]], endpoint: str | None, seconds: float | None
) -> None:
    async with asyncio.timeout(seconds), AsyncFish(endpoint) as fish:
        await show(fish)


async def _print_ticks(fish: AsyncFish) -> None:
    seq = 0
    async for tick in fish.ticks():
        if 0 < seq < tick.seq - 1:
            lost = tick.seq - seq - 1
            echo(f"fishctl: just before tick {tick.seq}, ticks were lost: {lost}", err=True)
        seq = tick.seq
        print_json_line(tick)


async def _print_lines(fish: AsyncFish) -> None:
    while True:
        status = await fish.status()
        pairs = format_quantities(status.quantities, status.quantity_units)
        quantities = "".join(f"  {name} {value}" for name, value in pairs)
        echo(
            f"{format_time_of_day(status.t)}  {text.quoted(status.name)}  "
            f"{status_line(status)}{quantities}"
        )
        await asyncio.sleep(1.0)


async def _draw(fish: AsyncFish) -> None:
    from fishd.cli.watch_screen import View

    view = View(await fish.status())
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
