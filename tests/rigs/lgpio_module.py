"""Emulated pins of the header, and a replacement of the C module lgpio that drives them.

rpi-lgpio's RPi.GPIO runs on it unchanged. Its error numbers, modes and checks are those of lgpio
0.2.2; a line that another process holds is busy.
"""

import os
import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Self

REVISION = "c03114"
"""Revision that rpi-lgpio reads: a Pi 4 B."""

_KERNEL_OUTPUT = 2
_ERRORS = {
    -5: "unknown handle",
    -73: "bad GPIO number",
    -78: "can not open gpiochip",
    -79: "GPIO busy",
    -80: "GPIO not allocated",
    -102: "bad PWM frequency",
    -103: "bad PWM dutycycle",
}
LINES = 54
"""Number of GPIOs of the emulated chip."""

INPUT, OUTPUT = 0x100, 0x200
"""Modes of a claimed pin."""
PULL_UP, PULL_DOWN, PULL_NONE = 32, 64, 128


@dataclass
class Line:
    """One pin: its mode, and the levels that drive it."""

    mode: int = 0
    pull: int = PULL_NONE
    driven: int = 0
    pwm: tuple[float, float] | None = None
    """Frequency [Hz] and duty cycle [%]."""
    busy: bool = False
    """Whether another process holds the pin."""

    @property
    def is_output(self) -> bool:
        """Whether the Pi drives the pin."""
        return bool(self.mode & OUTPUT)

    def level(self) -> int:
        """Return the level, from the side that drives the pin."""
        if self.is_output:
            return self.driven
        return int(self.pull == PULL_UP)


class Pins:
    """Pins of the header."""

    def __init__(self) -> None:
        self.lines = [Line() for _ in range(LINES)]
        self.present = True
        """Whether the GPIO chip exists."""


class Error(Exception):
    """Error like lgpio.error, which is not an OSError and has its text in quotes."""

    def __init__(self, number: int) -> None:
        super().__init__(_ERRORS[number])

    def __str__(self) -> str:
        return repr(self.args[0])


class EmulatedLgpio:
    """Context manager in which an import of RPi.GPIO uses these pins and a Pi 4 B."""

    def __init__(self, pins: Pins) -> None:
        self._pins = pins
        self._modules: dict[str, ModuleType] = {}
        self._revision: str | None = None

    def __enter__(self) -> Self:
        self._modules = _forget_modules()
        sys.modules["lgpio"] = _Lgpio(self._pins)
        self._revision = os.environ.get("RPI_LGPIO_REVISION")
        os.environ["RPI_LGPIO_REVISION"] = REVISION
        return self

    def __exit__(self, *_: object) -> None:
        _forget_modules()
        sys.modules.update(self._modules)
        if self._revision is None:
            os.environ.pop("RPI_LGPIO_REVISION", None)
        else:
            os.environ["RPI_LGPIO_REVISION"] = self._revision


class _Lgpio(ModuleType):
    """Replacement module with the functions that RPi.GPIO uses."""

    SET_PULL_UP, SET_PULL_DOWN, SET_PULL_NONE = PULL_UP, PULL_DOWN, PULL_NONE
    RISING_EDGE, FALLING_EDGE, BOTH_EDGES = 1, 2, 3
    GPIO_BUSY = -79
    error, error_text = Error, _ERRORS.get

    def __init__(self, pins: Pins) -> None:
        super().__init__("lgpio")
        self._pins = pins
        self._open = False

    def gpiochip_open(self, _number: int) -> int:
        if not self._pins.present:
            raise Error(-78)
        self._open = True
        return 0

    def gpiochip_close(self, handle: int) -> int:
        for gpio in range(LINES):
            self._free(self._line(handle, gpio))
        self._open = False
        return 0

    def gpio_get_chip_info(self, _handle: int) -> list[object]:
        return [0, LINES, "gpiochip0", "emulated"]

    def gpio_get_mode(self, handle: int, gpio: int) -> int:
        line = self._line(handle, gpio)
        kernel_flag = _KERNEL_OUTPUT if line.is_output else 0
        return line.mode | kernel_flag | line.pull

    def gpio_claim_input(self, handle: int, gpio: int, flags: int = 0) -> int:
        self._claim(self._line(handle, gpio), INPUT).pull = flags
        return 0

    def gpio_claim_output(self, handle: int, gpio: int, level: int = 0, flags: int = 0) -> int:
        line = self._line(handle, gpio)
        if not line.is_output:  # an existing output keeps its level
            self._claim(line, OUTPUT).pull = flags
            line.driven = int(bool(level))
        return 0

    def gpio_free(self, handle: int, gpio: int) -> int:
        line = self._line(handle, gpio)
        if not line.mode:
            raise Error(-80)
        self._free(line)
        return 0

    def gpio_read(self, handle: int, gpio: int) -> int:
        line = self._line(handle, gpio)
        if not line.mode:
            self._claim(line, INPUT)
        return line.level()

    def gpio_write(self, handle: int, gpio: int, level: int) -> int:
        line = self._line(handle, gpio)
        if not line.is_output:
            self._claim(line, OUTPUT)
        line.driven = int(bool(level))
        return 0

    def tx_pwm(self, handle: int, gpio: int, frequency: float, duty_cycle: float) -> int:
        line = self._line(handle, gpio)
        if frequency == 0.0:
            line.pwm = None
            return 0
        if not 0.1 <= frequency <= 10_000.0:
            raise Error(-102)
        if not 0.0 <= duty_cycle <= 100.0:
            raise Error(-103)
        if not line.is_output:
            self._claim(line, OUTPUT)
        line.pwm = (frequency, duty_cycle)
        return 9  # free entries in its queue

    def _line(self, handle: int, gpio: int) -> Line:
        if handle != 0 or not self._open:
            raise Error(-5)
        if not 0 <= gpio < LINES:
            raise Error(-73)
        return self._pins.lines[gpio]

    def _claim(self, line: Line, mode: int) -> Line:
        if line.busy:
            raise Error(-79)
        self._free(line)
        line.mode = mode
        return line

    @staticmethod
    def _free(line: Line) -> None:
        line.mode, line.pull, line.pwm = 0, PULL_NONE, None


def _forget_modules() -> dict[str, ModuleType]:
    """Remove lgpio and RPi.GPIO from the imported modules; return the removed modules."""
    names = [name for name in sys.modules if name.partition(".")[0] in ("lgpio", "RPi")]
    return {name: sys.modules.pop(name) for name in names}
