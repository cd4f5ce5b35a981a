"""Emulated GPIO chips, below gpiod: its Python part runs on them unchanged.

Errors are those of the kernel; a line that another process holds is busy.
"""

import errno
import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from fishd.virtual.pi.i2c import kernel_error

if TYPE_CHECKING:
    from gpiod import ChipInfo, EdgeEvent, LineInfo

LINES = 54
"""Number of GPIOs of the emulated chip."""
MAX_EVENTS = 16
"""Number of edges of each line that the kernel keeps for a program."""

INPUT, OUTPUT = 2, 3
"""Directions of a line; the numbers are those of libgpiod."""
PULL_NONE, PULL_UP, PULL_DOWN = 3, 4, 5
"""Biases of a line."""
RISING, FALLING, BOTH = 2, 3, 4
"""Edges that a program may wait for."""


@dataclass
class Line:
    """One pin, and the levels that drive it."""

    direction: int = INPUT
    pull: int = PULL_NONE
    consumer: str | None = None
    """Program that holds the pin, empty if the kernel does; None if it is free."""
    driven: int = 0
    outside: int | None = None
    watchers: list[Callable[[int], None]] = field(default_factory=list)
    """Functions called with the level after each edge."""

    @property
    def is_output(self) -> bool:
        """Whether the Pi drives the pin."""
        return self.direction == OUTPUT

    def level(self) -> int:
        """Return the level, from the side that drives the pin."""
        if self.is_output:
            return self.driven
        if self.outside is not None:
            return self.outside
        return int(self.pull == PULL_UP)


class Pins:
    """A GPIO chip; on that of a Pi's header, a line has the number of its GPIO."""

    def __init__(self, label: str = "pinctrl-bcm2711") -> None:
        self.label = label
        self.lines = [Line() for _ in range(LINES)]
        self.error = 0
        """Error number of each use of the chip, such as ENODEV; 0 while it works."""

    def set_level(self, gpio: int, level: int | None) -> None:
        """Drive a pin from outside, as a button does; None stops driving it."""
        line = self.lines[gpio]
        before = line.level()
        line.outside = level
        after = line.level()
        if after != before:
            for watcher in list(line.watchers):
                watcher(after)

    def check(self) -> None:
        """Raise OSError if the chip does not work."""
        if self.error:
            raise kernel_error(self.error)


class EmulatedGpiod:
    """Context manager in which gpiod finds these chips and no others.

    It replaces names of gpiod's C module in this process.
    """

    def __init__(self, *chips: Pins | None) -> None:
        """chips: those of /dev/gpiochip0, /dev/gpiochip1 and so on; None: no such file"""
        self._chips = {f"/dev/gpiochip{n}": chip for n, chip in enumerate(chips) if chip}
        self._replaced: dict[str, Any] = {}

    def __enter__(self) -> Self:
        """Raise ImportError if gpiod is not installed."""
        from gpiod import _ext

        names = {
            "is_gpiochip_device": self._chips.__contains__,
            "Chip": self._open,
            "LineConfig": _LineConfig,
            "LineSettings": _LineSettings,
        }
        self._replaced = {name: getattr(_ext, name) for name in names}
        vars(_ext).update(names)
        return self

    def __exit__(self, *_: object) -> None:
        from gpiod import _ext

        vars(_ext).update(self._replaced)

    def _open(self, path: str) -> "_Chip":
        if path not in self._chips:
            raise kernel_error(errno.ENOENT)
        self._chips[path].check()
        return _Chip(path, self._chips[path])


class _LineSettings(NamedTuple):
    """Settings of lines, as gpiod passes them."""

    direction: int
    edge_detection: int
    bias: int
    drive: int
    active_low: bool
    debounce_period: int
    event_clock: int
    output_value: int


class _LineConfig:
    """Settings by line."""

    def __init__(self) -> None:
        self.lines: dict[int, _LineSettings] = {}

    def add_line_settings(self, offsets: list[int], settings: _LineSettings) -> None:
        for offset in offsets:
            self.lines.setdefault(offset, settings)


class _Chip:
    """Open device file."""

    def __init__(self, path: str, pins: Pins) -> None:
        self._path, self._pins = path, pins

    def close(self) -> None:
        """Close the file; its requests remain."""

    def get_info(self) -> "ChipInfo":
        from gpiod import ChipInfo

        self._pins.check()
        return ChipInfo(self._path.rpartition("/")[2], self._pins.label, LINES)

    def get_line_name(self, offset: int) -> str:
        return f"GPIO{offset}"

    def get_line_info(self, offset: int, watch: bool) -> "LineInfo":
        from gpiod import LineInfo

        if watch:
            raise kernel_error(errno.EOPNOTSUPP)
        self._pins.check()
        line = self._pins.lines[offset]
        name, used = self.get_line_name(offset), line.consumer is not None
        consumer = line.consumer or ""
        return LineInfo(
            offset, name, used, consumer, line.direction, False, line.pull, 1, 1, 1, False, 0
        )

    def request_lines(
        self, line_cfg: _LineConfig, consumer: str | None, _event_buffer_size: int | None
    ) -> "_Request":
        self._pins.check()
        lines = {offset: self._pins.lines[offset] for offset in line_cfg.lines}
        if any(line.consumer is not None for line in lines.values()):
            raise kernel_error(errno.EBUSY)
        for offset, settings in line_cfg.lines.items():
            if settings.drive != 1 or settings.active_low or settings.debounce_period:
                raise kernel_error(errno.EOPNOTSUPP)
            line = lines[offset]
            line.consumer = consumer or "?"
            line.direction, line.pull = settings.direction, settings.bias
            line.driven = settings.output_value
        edges = {offset: settings.edge_detection for offset, settings in line_cfg.lines.items()}
        return _Request(self._path.rpartition("/")[2], self._pins, edges)


class _Request:
    """Lines that a program holds."""

    def __init__(self, chip_name: str, pins: Pins, edges: dict[int, int]) -> None:
        self.chip_name = chip_name
        self.offsets = list(edges)
        self.fd = os.eventfd(0, os.EFD_NONBLOCK)
        self._pins = pins
        self._events: deque[tuple[int, int, int]] = deque(maxlen=MAX_EVENTS * len(edges))
        """Type, time [ns] and line of each edge."""
        self._watchers = {offset: self._watch(offset, kind) for offset, kind in edges.items()}

    def release(self) -> None:
        for offset, watcher in self._watchers.items():
            line = self._pins.lines[offset]
            line.watchers.remove(watcher)
            line.consumer = None
        os.close(self.fd)

    def get_values(self, offsets: list[int], values: list[Any]) -> None:
        from gpiod.line import Value

        self._pins.check()
        values[:] = [Value(self._pins.lines[offset].level()) for offset in offsets]

    def set_values(self, values: dict[int, Any]) -> None:
        self._pins.check()
        for offset, value in values.items():
            if not self._pins.lines[offset].is_output:
                raise kernel_error(errno.EPERM)
            self._pins.lines[offset].driven = value.value

    def read_edge_events(self, _max_events: int | None) -> list["EdgeEvent"]:
        from gpiod import EdgeEvent

        self._pins.check()
        os.eventfd_read(self.fd)
        return [EdgeEvent(*self._events.popleft(), 0, 0) for _ in range(len(self._events))]

    def _watch(self, offset: int, edges: int) -> Callable[[int], None]:
        def watch(level: int) -> None:
            if edges in (BOTH, RISING if level else FALLING):
                self._events.append((1 if level else 2, time.monotonic_ns(), offset))
                os.eventfd_write(self.fd, 1)

        self._pins.lines[offset].watchers.append(watch)
        return watch
