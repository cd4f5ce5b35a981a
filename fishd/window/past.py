"""Ten minutes of a fish for pages that open: the lowest and the highest values of short bins.

What costs little at each tick need not be computed while a page opens.
"""

import math
from collections import deque
from collections.abc import Iterable

from msgspec import UNSET

from fishd.core.signals import Tick
from fishd.window.live import encode, encode_message

KEPT_S = 600.0
BIN_S = 0.5
"""Time of a bin [s]."""
PART_BINS = 20
"""Number of bins in a message."""
MAX_COLUMNS = 64
"""Number of columns, as in a page."""
DIGITS = 6
_FIELDS = ("t", "seq", "fx", "fy", "fin_velocity", "thrust", "alpha", "phi", "speed")
"""Fields of a tick that a chart shows, without those that depend on other fields."""

Bin = dict[str, list[float]]
"""Lowest and highest value by name of the column."""


class Past:
    """Lowest and highest values of the ticks of a fish, encoded once."""

    def __init__(self) -> None:
        parts = math.ceil(KEPT_S / BIN_S / PART_BINS)
        self._messages: deque[bytes] = deque(maxlen=parts)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._messages.clear()
        self._bins: list[tuple[int, Bin]] = []
        """Number and values of each bin that is in no message yet."""

    def messages(self) -> list[bytes]:
        """Return messages for a page; only the latest bins need to be encoded."""
        return [*self._messages, *([_encode(self._bins)] if self._bins else [])]

    def add(self, tick: Tick) -> None:
        """Add a tick."""
        number = math.floor(tick.time / BIN_S)
        if not self._bins or number != self._bins[-1][0]:
            if len(self._bins) == PART_BINS:
                self._messages.append(_encode(self._bins))
                self._bins = []
            self._bins.append((number, {}))
        columns = self._bins[-1][1]
        for name, value in _values(tick):
            extremes = columns.get(name)
            if extremes is None:
                if len(columns) < MAX_COLUMNS:
                    columns[name] = [value, value]
            elif value < extremes[0]:
                extremes[0] = value
            elif value > extremes[1]:
                extremes[1] = value


def _values(tick: Tick) -> Iterable[tuple[str, float]]:
    """Yield name and value of each column, as a page names them."""
    for name in _FIELDS:
        if (value := getattr(tick, name)) is not UNSET:
            yield name, value
    if tick.servo_on:
        yield "phi_c", tick.phi_c
    if tick.suspect is not UNSET:
        yield from (("suspect_fx", tick.fx), ("suspect_fy", tick.fy))
    if tick.thrust_ci95 is not UNSET:
        yield "thrust_low", tick.thrust - tick.thrust_ci95
        yield "thrust_high", tick.thrust + tick.thrust_ci95
    for kind, values in (("quantity", tick.quantities), ("reading", tick.readings)):
        if values is not UNSET:
            for name, value in values.items():
                yield f"{kind}:{name}", value


def _encode(bins: list[tuple[int, Bin]]) -> bytes:
    """Return bins as a message with columns, in which each bin has two rows."""
    columns: dict[str, list[float | None]] = {
        "time": [(number + part) * BIN_S for number, _ in bins for part in (0.25, 0.75)]
    }
    names = dict.fromkeys(name for _, values in bins for name in values)
    for name in list(names)[:MAX_COLUMNS]:
        rows = [value for _, values in bins for value in values.get(name, (None, None))]
        exact = name in ("t", "seq")
        columns[name] = [
            value if exact or value is None else float(f"{value:.{DIGITS}g}") for value in rows
        ]
    return encode_message("past", encode(columns))
