"""The verb that shows a fish live in the terminal: force, command, thrust and timing."""

import asyncio
import math
import os
import signal
import sys
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import suppress
from datetime import datetime
from typing import TYPE_CHECKING, NamedTuple

import click

from fishd import text
from fishd.cli.options import endpoint_option, json_option
from fishd.cli.output import echo, print_json_line, spelled
from fishd.client import AsyncFish
from fishd.console import status_line
from fishd.signals import Event, Status, Tick

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.table import Table
    from rich.text import Text

REDRAW = 0.1
"""Least time from one drawing to the next [s]; every tick that came meanwhile is in it."""
SPAN = 5.0
"""How far back the traces go [s]."""
MODES = {"idle": "cyan", "running": "green", "fault": "red", "estop": "red"}
LEVELS = {"warning": "yellow", "error": "red"}


class Trace(NamedTuple):
    """One quantity against time."""

    name: str
    style: str
    least: float
    """The scale reaches from minus this to plus this at least, so that noise looks small."""
    value: Callable[[Tick], float]


TRACES = (
    Trace("fx mN", "cyan", 2.0, lambda tick: tick.fx * 1e3),
    Trace("fy mN", "yellow", 2.0, lambda tick: tick.fy * 1e3),
    Trace("phi_c rad", "green", 0.1, lambda tick: tick.phi_c),
)
LABEL = 14
"""Columns left of the axis: a name and a number."""


@click.command()
@endpoint_option
@json_option
@click.option(
    "--seconds",
    type=click.FloatRange(min=0, min_open=True),
    help="End by itself after this time; by default Ctrl-C ends it.",
)
def watch(endpoint: str | None, as_json: bool, seconds: float | None) -> None:
    """Watch force, command and timing live, until Ctrl-C.

    'late' and 'busy' are the worst of the last 5 s, 'missed' counts slots that the daemon skipped,
    'lost' counts ticks that did not arrive here. Where standard output is not a terminal, a line
    is printed every second instead; with --json, every tick as one line.
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
    async for tick in fish.ticks():
        print_json_line(tick)


async def _print_lines(fish: AsyncFish) -> None:
    while True:
        status = await fish.status()
        echo(f"{_clock(status.t)}  {status_line(status)}")
        await asyncio.sleep(1.0)


async def _draw(fish: AsyncFish) -> None:
    from rich.live import Live

    view = View(await fish.status())
    fish.telemetry_address = view.status.telemetry
    events = asyncio.create_task(view.collect(fish.events()))
    drawn = -math.inf
    try:
        with Live(screen=True, auto_refresh=False) as live:
            async for tick in fish.ticks():
                view.add(tick)
                # Counted from the end of a drawing: what a slow terminal held up is read first.
                if time.monotonic() - drawn >= REDRAW:
                    if view.outdated:
                        view.status = await fish.status()
                    live.update(view, refresh=True)
                    drawn = time.monotonic()
    finally:
        events.cancel()


class View:
    """What is on the screen; adapts to the size of the screen each time it is drawn."""

    def __init__(self, status: Status) -> None:
        self.status = status
        self._ticks: deque[Tick] = deque()
        self._events: deque[Event] = deque(maxlen=3)
        self._lost = 0

    def add(self, tick: Tick) -> None:
        """Take in a tick, and forget those of more than `SPAN` ago."""
        ticks = self._ticks
        if ticks:
            # After a restart of the daemon, ticks are numbered from 1 again.
            self._lost += max(0, tick.seq - ticks[-1].seq - 1)
        ticks.append(tick)
        while abs(tick.t - ticks[0].t) > SPAN:
            ticks.popleft()

    async def collect(self, events: AsyncIterator[Event]) -> None:
        """Keep the latest of `events`, for ever."""
        async for event in events:
            self._events.append(event)

    @property
    def outdated(self) -> bool:
        """True once the status is a second old, or no longer that of the latest tick."""
        tick, status = self._ticks[-1], self.status
        known = (status.mode, status.controller) == (tick.mode, tick.controller)
        return not known or abs(tick.t - status.t) >= 1.0

    def __rich_console__(self, console: "Console", options: "ConsoleOptions") -> "RenderResult":
        """Header, as many traces as there is room for, and events below them on a tall screen."""
        from rich.text import Text

        width, height = options.max_width, options.height or console.height
        header = [self._title()]
        if reason := self.status.reason:
            message = text.line(f"{reason.code}: {reason.message}")
            header += Text(message, "red").wrap(console, width)
        elif took_over := self.status.fallback:
            message = text.line(f"took over: {took_over.code}: {took_over.message}")
            header += Text(message, "yellow").wrap(console, width)
        yield from header
        yield self._figures()
        events = max(0, min(3, (height - 14) // 3))
        room = height - len(header) - 2 - events - 1  # 2 rows of figures, 1 for the time axis
        traces = TRACES[: max(0, room // 2)] if width >= 2 * LABEL else ()
        for trace in traces:
            yield self._plot(trace, width, room // len(traces))
        if traces:
            ago = f"-{SPAN:g} s"
            yield Text(f"{'':{LABEL + 1}}{ago:<{width - LABEL - 4}}now", "dim")
        for event in list(self._events)[-events:] if events else ():
            yield self._event(event)

    def _title(self) -> "Text":
        from rich.text import Text

        tick = self._ticks[-1]
        return Text.assemble(
            (f" {text.quoted(tick.mode).upper()} ", f"bold reverse {MODES.get(tick.mode, 'none')}"),
            (f" {text.quoted(tick.controller)} ", "bold"),
            spelled(self.status.parameters),
            "" if tick.servo_on else ("  no pulses", "dim"),
            ("  servo not reached", "red") if self.status.servo_lost else "",
            no_wrap=True,
            overflow="ellipsis",
        )

    def _figures(self) -> "Table":
        from rich.table import Table

        tick = self._ticks[-1]
        figures = {
            "thrust": "– mN" if self.status.sensor_lost else f"{tick.thrust * 1e3:.2f} mN",
            "tail beat": f"{tick.frequency:.2f} Hz",
            "late": f"{max(tick.lateness_us for tick in self._ticks):.0f} µs",
            "busy": f"{max(tick.busy_us for tick in self._ticks):.0f} µs",
            "missed": f"{tick.missed}",
            "lost": f"{self._lost}",
        }
        table = Table.grid(padding=(0, 3, 0, 0))
        for _ in figures:
            table.add_column(min_width=7, no_wrap=True)
        table.add_row(*figures, style="dim")
        table.add_row(*figures.values(), style="bold")
        return table

    def _plot(self, trace: Trace, width: int, rows: int) -> "Text":
        """A trace with its name and scale to the left; lost ticks leave a gap."""
        from rich.text import Text

        from fishd.cli.braille import curve

        values = [trace.value(tick) for tick in self._ticks]
        low, high = _scale(values, trace.least)
        now = self._ticks[-1].t
        points = [(now - SPAN, math.nan)]
        for before, tick, value in zip((None, *self._ticks), self._ticks, values, strict=False):
            if before and tick.seq - before.seq != 1:
                points.append((before.t, math.nan))
            points.append((tick.t, (value - low) / (high - low)))
        labels = [""] * rows
        labels[round(high / (high - low) * (rows - 1))] = "0"
        labels[-1] = f"{low:g}"
        labels[0] = f"{trace.name:<9}{high:>{LABEL - 9}g}"
        drawn = curve(points, now - SPAN, now, rows, width - LABEL - 1)
        lines = (f"{label:>{LABEL}}┤{line}" for label, line in zip(labels, drawn, strict=True))
        return Text("\n".join(lines), trace.style, no_wrap=True)

    def _event(self, event: Event) -> "Text":
        from rich.text import Text

        return Text.assemble(
            (f"{_clock(event.t)} ", "dim"),
            (text.line(f"{event.kind}: {event.message}"), LEVELS.get(event.level, "none")),
            no_wrap=True,
            overflow="ellipsis",
        )


def _scale(values: Sequence[float], least: float) -> tuple[float, float]:
    """Round limits around `values`, zero and ±`least`, so that the scale seldom changes."""
    low, high = min([-least, *values]), max([least, *values])
    step = 10.0 ** math.floor(math.log10(high - low)) / 2.0
    return step * math.floor(low / step), step * math.ceil(high / step)


def _clock(t: float) -> str:
    return f"{datetime.fromtimestamp(t):%H:%M:%S}"
