"""Emulated pins of a header, driven by the Pi or from outside."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

LINES = 54
"""Number of GPIOs of the emulated chip."""

INPUT, OUTPUT, ALERT = 0x100, 0x200, 0x400
"""Modes of a claimed pin; ALERT is an input that reports its edges."""
PULL_UP, PULL_DOWN, PULL_NONE = 32, 64, 128

EdgeFunction = Callable[[int, int, int, int], None]
"""Function called with chip, GPIO, level and time."""


@dataclass
class Line:
    """One pin: its mode, and the levels that drive it."""

    mode: int = 0
    pull: int = PULL_NONE
    edges: int = 0
    driven: int = 0
    outside: int | None = None
    pwm: tuple[float, float] | None = None
    busy: bool = False
    writes: list[int] = field(default_factory=list)

    def level(self) -> int:
        """Return the level, from the side that drives the pin."""
        if self.mode & OUTPUT:
            return self.driven
        if self.outside is not None:
            return self.outside
        return int(self.pull == PULL_UP)


class Pins:
    """Pins of the header."""

    def __init__(self) -> None:
        self.lines = [Line() for _ in range(LINES)]
        self.callbacks: list[Callback] = []
        self.present = True
        """Whether the GPIO chip exists."""
        self.reports_edges = True
        """Whether edges can be reported; false as with old libraries on kernels from 6.6 on."""

    def set_level(self, gpio: int, level: int | None) -> None:
        """Drive a pin from outside, as a button does; None stops driving it.

        Returns after the callbacks of its edges, which run in a separate thread.
        """
        line = self.lines[gpio]
        before = line.level()
        line.outside = level
        after = line.level()
        edge = 1 if after > before else 2 if after < before else 0
        if not (line.mode & ALERT and line.edges & edge):
            return
        for callback in [item for item in self.callbacks if item.gpio == gpio]:
            thread = threading.Thread(target=callback.function, args=(0, gpio, after, 0))
            thread.start()
            thread.join()

    def level(self, gpio: int) -> int:
        """Return the level of a pin; 0 where nothing drives it."""
        return self.lines[gpio].level()

    def is_output(self, gpio: int) -> bool:
        """Return whether the Pi drives a pin."""
        return bool(self.lines[gpio].mode & OUTPUT)

    def pull(self, gpio: int) -> str:
        """Return the resistor at a pin: up, down or none."""
        return {PULL_UP: "up", PULL_DOWN: "down"}.get(self.lines[gpio].pull, "none")

    def writes(self, gpio: int) -> list[int]:
        """Return all levels written to a pin, oldest first."""
        return list(self.lines[gpio].writes)

    def pwm(self, gpio: int) -> tuple[float, float] | None:
        """Return frequency [Hz] and duty cycle [%] of the PWM on a pin; None without PWM."""
        return self.lines[gpio].pwm

    def occupy(self, gpio: int, busy: bool = True) -> None:
        """Mark a pin as held by another process, or as free."""
        self.lines[gpio].busy = busy


class Callback:
    """Registered callback, like the object that lgpio.callback returns."""

    def __init__(self, pins: Pins, gpio: int, function: EdgeFunction) -> None:
        self.gpio = gpio
        self.function = function
        self._pins = pins
        pins.callbacks.append(self)

    def cancel(self) -> None:
        """Stop the reports of the pin's edges."""
        if self in self._pins.callbacks:
            self._pins.callbacks.remove(self)
