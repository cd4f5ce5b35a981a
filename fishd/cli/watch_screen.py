"""The screen of `fishctl watch`: a header, traces in braille, and the latest events."""

import math
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from msgspec import UNSET
from msgspec.structs import replace
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from fishd.cli.output import format_controller, format_quantities, format_time_of_day
from fishd.core import text
from fishd.core.console import format_readings, format_thrust
from fishd.core.robots import find_kind
from fishd.core.signals import Event, Status, Tick

if TYPE_CHECKING:
    from fishd.camera.tail_watch import TailWatch

TRACE_SPAN_S = 5.0
"""Time that the traces show [s]."""
MODES = {"idle": "cyan", "running": "green", "fault": "red", "estop": "red"}
LEVELS = {"warning": "yellow", "error": "red"}


class Trace(NamedTuple):
    """One quantity against time."""

    name: str
    """Name, with its unit."""
    style: str
    min_end: float
    """Smallest end of the scale, on either side, so that noise looks small."""
    value: Callable[[Tick], float]


TRACES = (
    Trace("fx m{force_unit}", "cyan", 2.0, lambda tick: tick.fx * 1e3),
    Trace("fy m{force_unit}", "yellow", 2.0, lambda tick: tick.fy * 1e3),
    Trace("phi_c rad", "green", 0.1, lambda tick: tick.phi_c),
)
LABEL_COLUMNS = 14
"""Width of the labels left of the axis: a name and a number [columns]."""
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of the dots of a braille character, four rows of two."""


class View:
    """Content of the screen; it adapts to the size of the screen each time it is drawn."""

    def __init__(self, status: Status, tail: "TailWatch | None" = None) -> None:
        """tail: fin angles of a camera; None leaves them out"""
        self.status = status
        self._tail = tail
        self._ticks: deque[Tick] = deque()
        self._events: deque[Event] = deque(maxlen=3)
        self._lost = 0

    def add(self, tick: Tick) -> None:
        """Add a tick, and drop those older than `TRACE_SPAN_S`."""
        ticks = self._ticks
        if ticks:
            # After a restart of the daemon, ticks are numbered from 1 again.
            self._lost += max(0, tick.seq - ticks[-1].seq - 1)
        ticks.append(tick)
        while abs(tick.time - ticks[0].time) > TRACE_SPAN_S:
            ticks.popleft()

    async def collect(self, events: AsyncIterator[Event]) -> None:
        """Keep the latest of `events`, until cancelled."""
        async for event in events:
            self._events.append(event)

    @property
    def outdated(self) -> bool:
        """Whether the status is a second old, or does not match the latest tick."""
        tick, status = self._ticks[-1], self.status
        is_current = (status.mode, status.controller) == (tick.mode, tick.controller)
        return not is_current or abs(tick.time - status.clock) >= 1.0

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the header, as many traces as fit, and events below them on a tall screen."""
        width, height = options.max_width, options.height or console.height
        header = [self._title_line()]
        reason, fallback = self.status.reason, self.status.fallback
        if cause := reason or fallback or self.status.lease_expiry:
            message = text.line(
                f"{'took over: ' if cause is fallback else ''}{cause.code}: {cause.message}"
            )
            header += Text(message, "red" if reason else "yellow").wrap(console, width)
        if holder := self.status.lease:
            header.append(_cut_line(text.line(f"held by {holder}, for {holder.age:.0f} s")))
        yield from header
        quantities = self._value_lines()
        yield self._figure_table()
        yield from quantities
        events = max(0, min(3, (height - 14) // 3))
        # 2 rows of figures, 1 for the time axis.
        free_rows = height - len(header) - 2 - len(quantities) - events - 1
        traces = TRACES[: max(0, free_rows // 2)] if width >= 2 * LABEL_COLUMNS else ()
        for trace in traces:
            yield self._draw_trace(trace, width, free_rows // len(traces))
        if traces:
            ago = f"-{TRACE_SPAN_S:g} s"
            yield Text(f"{'':{LABEL_COLUMNS + 1}}{ago:<{width - LABEL_COLUMNS - 4}}now", "dim")
        for event in list(self._events)[-events:] if events else ():
            yield _cut_line(
                (f"{format_time_of_day(event.t)} ", "dim"),
                (text.line(f"{event.kind}: {event.message}"), LEVELS.get(event.level, "none")),
            )

    def _title_line(self) -> Text:
        tick = self._ticks[-1]
        return _cut_line(
            f"{text.quoted(self.status.name)} " if self.status.name else "",
            (f" {text.quoted(tick.mode).upper()} ", f"bold reverse {MODES.get(tick.mode, 'none')}"),
            (f" {text.quoted(tick.controller)} ", "bold"),
            format_controller(self.status.controller, self.status.parameters).partition(" ")[2],
            "" if tick.servo_on else ("  no pulses", "dim"),
            ("  servo not reached", "red") if self.status.servo_lost else "",
        )

    def _figure_table(self) -> Table:
        tick = self._ticks[-1]
        current = replace(
            self.status,
            thrust=tick.thrust,
            thrust_ci95=None if tick.thrust_ci95 is UNSET else tick.thrust_ci95,
        )
        speed = tick.speed
        figures = {
            **({"speed": f"{speed * 1e3:.1f} mm/s"} if isinstance(speed, float) else {}),
            "thrust": format_thrust(current),
            "tail beat": f"{tick.frequency:.2f} Hz",
            **(self._timing_figures() if find_kind(self.status.robot).is_real_time else {}),
            "lost": f"{self._lost}",
        }
        table = Table.grid(padding=(0, 3, 0, 0))
        for _ in figures:
            table.add_column(min_width=7, no_wrap=True)
        table.add_row(*figures, style="dim")
        table.add_row(*figures.values(), style="bold")
        return table

    def _timing_figures(self) -> dict[str, str]:
        """Return lateness, computing time and skipped ticks; not shown in slow motion."""
        return {
            "late": f"{max(tick.lateness_us for tick in self._ticks):.0f} µs",
            "compute": f"{max(tick.busy_time_us for tick in self._ticks):.0f} µs",
            "skipped": f"{self._ticks[-1].missed_slots}",
        }

    def _value_lines(self) -> list[Text]:
        """Return a line each of readings, of the controller's quantities, and of the camera."""
        now = self._ticks[-1].quantities
        quantities = now if isinstance(now, dict) else {}
        lines = (
            format_readings(self.status),
            format_quantities(quantities, self.status.quantity_units),
        )
        shown = [
            _cut_line(*(part for entry in line for part in _style_entry(*entry)))
            for line in lines
            if line
        ]
        return [*shown, _cut_line(self._tail.describe())] if self._tail else shown

    def _draw_trace(self, trace: Trace, width: int, rows: int) -> Text:
        """Return a trace with its name and scale to the left; lost ticks leave a gap."""
        values = [trace.value(tick) for tick in self._ticks]
        low, high = _choose_scale(values, trace.min_end)
        now = self._ticks[-1].time
        points = [(now - TRACE_SPAN_S, math.nan)]
        for previous, tick, value in zip((None, *self._ticks), self._ticks, values, strict=False):
            if previous and tick.seq - previous.seq != 1:
                points.append((previous.time, math.nan))
            points.append((tick.time, (value - low) / (high - low)))
        labels = [""] * rows
        labels[round(high / (high - low) * (rows - 1))] = "0"
        labels[-1] = f"{low:g}"
        name = trace.name.format(force_unit=text.quoted(self.status.force_unit))
        labels[0] = f"{name:<9}{high:>{LABEL_COLUMNS - 9}g}"
        curve = _draw_curve(points, now - TRACE_SPAN_S, now, rows, width - LABEL_COLUMNS - 1)
        lines = (
            f"{label:>{LABEL_COLUMNS}}┤{line}" for label, line in zip(labels, curve, strict=True)
        )
        return Text("\n".join(lines), trace.style, no_wrap=True)


def _style_entry(name: str, value: str) -> tuple[tuple[str, str], ...]:
    return (f"{name} ", "dim"), (f"{value}   ", "bold")


def _cut_line(*parts: str | tuple[str, str]) -> Text:
    """Return a text that is cut where the screen ends; parts: each with its style."""
    return Text.assemble(*parts, no_wrap=True, overflow="ellipsis")


def _choose_scale(values: Sequence[float], min_end: float) -> tuple[float, float]:
    """Return round limits around `values`, zero and ±`min_end`, that seldom change."""
    low, high = min([-min_end, *values]), max([min_end, *values])
    step = 10.0 ** math.floor(math.log10(high - low)) / 2.0
    return step * math.floor(low / step), step * math.ceil(high / step)


def _draw_curve(
    points: Sequence[tuple[float, float]], start: float, end: float, rows: int, columns: int
) -> list[str]:
    """Draw the line through `points`, as `rows` strings of `columns` braille characters.

    points: x in rising order, and y from 0 at the bottom to 1 at the top; NaN leaves a gap
    start, end: x at the left and at the right edge
    """
    x, y = np.array(points).T
    across = np.linspace(start, end, 2 * columns)
    level = (1.0 - np.interp(across, x, y)) * (4 * rows - 1)
    before = np.concatenate((level[:1], level[:-1]))  # so that a jump is a stroke
    upper, lower = np.rint(np.fmin(level, before)), np.rint(np.fmax(level, before))
    down = np.arange(4 * rows)[:, None]
    dots = ((upper <= down) & (down <= lower)).reshape(rows, 4, columns, 2)
    codes = 0x2800 + np.einsum("rick,ik->rc", dots, _DOTS)
    return ["".join(map(chr, line)) for line in codes]
