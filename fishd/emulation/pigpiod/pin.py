"""One GPIO of the emulated pigpiod: its mode, pull, level and pulses."""

from enum import Enum

from fishd.emulation.pulses import PulseTrain

INPUT, OUTPUT = 0, 1
PULL_DOWN, PULL_UP = 1, 2


class Use(Enum):
    """What a GPIO was last told to do."""

    NOTHING = "nothing"
    WRITE = "write"
    PWM = "PWM"
    SERVO = "servo"
    HARDWARE_PWM = "hardware PWM"


class Pin:
    """One GPIO."""

    def __init__(self, gpio: int, idle_range: int, peripheral: int | None = None) -> None:
        """`peripheral`: the mode in which the PWM peripheral drives it; None where it cannot."""
        self.peripheral = peripheral
        self.use = Use.NOTHING
        self.mode = INPUT
        # At power-on a Pi pulls the low ones up and all others down.
        self.pull = PULL_UP if gpio <= 8 else PULL_DOWN
        self.latch = 0
        self.width = 0
        self.duty_range = 255
        self.real_range = idle_range
        self.train = PulseTrain()

    @property
    def connected(self) -> bool:
        """Whether the PWM peripheral drives it, whoever wanted that."""
        return self.mode == self.peripheral

    def level(self, time: float) -> int:
        """The level at a time [s]."""
        if self.connected:
            return self.train.level(time)
        if self.mode == OUTPUT:
            return self.latch or self.train.level(time)
        return int(self.pull == PULL_UP)
