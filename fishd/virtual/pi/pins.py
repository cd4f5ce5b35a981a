"""The pins of a header in memory: what is wired to them, and what the Pi does with them."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

LINES = 54
"""GPIOs of the emulated chip."""

INPUT, OUTPUT, ALERT = 0x100, 0x200, 0x400
"""How a pin is claimed; an alert is an input whose edges are reported."""
PULL_UP, PULL_DOWN, PULL_NONE = 32, 64, 128

EdgeFunction = Callable[[int, int, int, int], None]
"""Called with chip, GPIO, level and time."""


@dataclass
class Line:
    """One pin: how it is claimed, and what drives it."""

    mode: int = 0
    pull: int = PULL_NONE
    edges: int = 0
    driven: int = 0
    outside: int | None = None
    pwm: tuple[float, float] | None = None
    busy: bool = False
    writes: list[int] = field(default_factory=list)

    def level(self) -> int:
        """The level, from whichever side it is driven."""
        if self.mode & OUTPUT:
            return self.driven
        if self.outside is not None:
            return self.outside
        return int(self.pull == PULL_UP)


class Pins:
    """What is wired to the header, and what the Pi does with it."""

    def __init__(self) -> None:
        self.lines = [Line() for _ in range(LINES)]
        self.callbacks: list[Callback] = []
        self.present = True
        """False: there is no chip to open."""
        self.reports_edges = True
        """False: as old libraries on kernels from 6.6 on, pins can be read but not listened to."""

    def set_level(self, gpio: int, level: int | None) -> None:
        """Drive a pin from outside, as a button does; None lets go of it.

        Returns when the callbacks of its edges are done, which run in a thread of their own.
        """
        line = self.lines[gpio]
        before = line.level()
        line.outside = level
        after = line.level()
        edge = 1 if after > before else 2 if after < before else 0
        if not (line.mode & ALERT and line.edges & edge):
            return
        for callback in [c for c in self.callbacks if c.gpio == gpio]:
            thread = threading.Thread(target=callback.function, args=(0, gpio, after, 0))
            thread.start()
            thread.join()

    def level(self, gpio: int) -> int:
        """Level of a pin, from whichever side it is driven; 0 where nothing drives it."""
        return self.lines[gpio].level()

    def is_output(self, gpio: int) -> bool:
        """Whether the Pi drives a pin."""
        return bool(self.lines[gpio].mode & OUTPUT)

    def pull(self, gpio: int) -> str:
        """The resistor at a pin: up, down or none."""
        return {PULL_UP: "up", PULL_DOWN: "down"}.get(self.lines[gpio].pull, "none")

    def writes(self, gpio: int) -> list[int]:
        """Every level that was written to a pin, oldest first."""
        return list(self.lines[gpio].writes)

    def pwm(self, gpio: int) -> tuple[float, float] | None:
        """Frequency [Hz] and duty cycle [%] of the PWM on a pin; None without."""
        return self.lines[gpio].pwm

    def occupy(self, gpio: int, busy: bool = True) -> None:
        """Let another process hold a pin, or let go of it."""
        self.lines[gpio].busy = busy


class Callback:
    """As the object that lgpio.callback returns."""

    def __init__(self, pins: Pins, gpio: int, function: EdgeFunction) -> None:
        self.gpio = gpio
        self.function = function
        self._pins = pins
        pins.callbacks.append(self)

    def cancel(self) -> None:
        """Hear no more of the pin's edges."""
        if self in self._pins.callbacks:
            self._pins.callbacks.remove(self)
