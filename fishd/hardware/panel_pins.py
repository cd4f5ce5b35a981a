"""Pins of the operator's panel, through libgpiod's own package gpiod."""

import logging
import os
import select
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fishd.core.errors import MissingPackage, StartupError

if TYPE_CHECKING:
    from gpiod import LineRequest, LineSettings

log = logging.getLogger(__name__)

HEADER_LABELS = ("pinctrl-bcm2835", "pinctrl-bcm2711", "pinctrl-rp1")
"""Labels of the chip of the header: up to a Pi 3 and Zero 2, on a Pi 4, and on a Pi 5.

Its number is another one on other kernels: 0 or 4 on a Pi 5.
"""
MAX_CHIPS = 64
"""Number of device files /dev/gpiochipN that are tried."""
BOUNCE_MS = 5
"""Time for which the contact of a button may bounce [ms]."""
CONSUMER = "fishd"
"""Name that the kernel shows as the user of the pins."""


def find_chip() -> str:
    """Return the path of the header's GPIO chip.

    Raises `MissingPackage` without gpiod, and `StartupError` if the chip cannot be used.
    """
    try:
        import gpiod.line_settings  # versions 1.x, with another API, do not have it
    except ImportError:
        raise MissingPackage(
            "E-stop button and status light need the package gpiod, 2.3 or later; install fishd[pi]"
        ) from None

    others, denied = [], ""
    for path in (f"/dev/gpiochip{number}" for number in range(MAX_CHIPS)):
        if not gpiod.is_gpiochip_device(path):
            continue
        try:
            with gpiod.Chip(path) as chip:
                label = chip.get_info().label
        except PermissionError:
            denied = path
            continue
        except OSError as error:
            label = error.strerror or str(error)
        if label in HEADER_LABELS:
            return path
        others.append(f"{path} ({label})")
    if denied:
        raise StartupError(
            f"{denied} may not be opened by this user; "
            "'sudo usermod -aG gpio USER', log in again, then try again"
        )
    chips = f"there is only {', '.join(others)}" if others else "there is no /dev/gpiochipN"
    raise StartupError(
        f"the GPIO chip of the header is missing, {chips}; "
        "button and light need a Pi with Raspberry Pi OS"
    )


class PanelPins:
    """Pin of a button, a contact to ground with a pull-up, and pin of a light, through gpiod.

    One of them may be absent.
    """

    def __init__(self, button: int | None, light: int | None) -> None:
        """Claim the pins; raises `StartupError`, and the errors of `find_chip`."""
        chip = find_chip()
        from gpiod.line import Bias, Direction, Edge, Value
        from gpiod.line_settings import LineSettings

        self._button: Any = button
        self._light: Any = light
        self._levels = (Value.INACTIVE, Value.ACTIVE)
        self._lock = threading.Lock()  # a request must not be used by two threads at a time
        self._thread: threading.Thread | None = None
        lines: dict[Any, LineSettings | None] = {}
        if button is not None:
            # Not debounced by the kernel: it would report the old level, also to polls, for as
            # long as a loose contact chatters.
            lines[button] = LineSettings(
                direction=Direction.INPUT, bias=Bias.PULL_UP, edge_detection=Edge.BOTH
            )
        if light is not None:
            lines[light] = LineSettings(direction=Direction.OUTPUT)
        self._request = _claim(chip, lines)

    def listen(self, on_edge: Callable[[], None]) -> None:
        """Call a function, from another thread, after each edge of the button."""
        self._end = os.eventfd(0)
        self._thread = threading.Thread(
            target=self._report_edges, args=(on_edge,), name="estop-button", daemon=True
        )
        self._thread.start()

    def is_high(self) -> bool:
        """Return the level of the button; raise OSError if it cannot be read."""
        with self._lock:
            return bool(self._request.get_value(self._button))

    def switch(self, lit: bool) -> None:
        """Switch the light; raise OSError if that fails."""
        with self._lock:
            self._request.set_value(self._light, self._levels[lit])

    def close(self) -> None:
        """Release the pins, and stop reporting edges."""
        if self._thread:
            os.eventfd_write(self._end, 1)
            self._thread.join()
            os.close(self._end)
        self._request.release()

    def _report_edges(self, on_edge: Callable[[], None]) -> None:
        edges, end = select.poll(), select.poll()
        edges.register(self._request.fd, select.POLLIN)
        for poll in (edges, end):
            poll.register(self._end, select.POLLIN)
        while self._end not in dict(edges.poll()):
            try:
                with self._lock:
                    self._request.read_edge_events()
            except OSError as error:  # the chip is gone; polls of the level report it, too
                log.warning(
                    "E-stop button: its edges are not reported any more: %s",
                    error.strerror or error,
                )
                return
            on_edge()
            end.poll(BOUNCE_MS)  # edges of this time are waiting together, and are reported then


def _claim(path: str, lines: "dict[Any, LineSettings | None]") -> "LineRequest":
    """Claim lines of a chip; raise `StartupError` if that is not possible."""
    import gpiod

    try:
        with gpiod.Chip(path) as chip:
            try:
                return chip.request_lines(lines, consumer=CONSUMER)
            except OSError:
                infos = [chip.get_line_info(pin) for pin in lines]
                users = [(i.offset, i.consumer or "the kernel") for i in infos if i.used]
                if not users:
                    raise
    except OSError as error:
        names = " and ".join(f"GPIO {pin}" for pin in lines)
        raise StartupError(
            f"the panel cannot use {names} of {path}: {error.strerror or error}"
        ) from None
    raise StartupError(
        "the panel cannot use its pins: "
        + ", ".join(f"GPIO {pin} is held by {user}" for pin, user in users)
        + "; stop that program, remove its dtoverlay, or choose another pin"
    )
