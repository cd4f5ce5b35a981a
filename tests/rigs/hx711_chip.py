"""HX711 chips emulated at the level of their two wires, and the RPi.GPIO that reads them.

They follow the data sheet of Avia Semiconductor. Each call of RPi.GPIO takes two microseconds.
"""

import sys
from collections.abc import Callable
from types import ModuleType

from fishd.core.clock import VirtualClock

CALL = 2e-6
POWER_DOWN = 60e-6
GAINS = {25: 128, 26: 32, 27: 64}
STEPS = 1 << 23


class Hx711Chip:
    """Emulated chip; its channel A measures `volts`."""

    def __init__(
        self,
        clock: VirtualClock,
        volts: Callable[[float, float], float],
        rate: float = 80.0,
        supply: float = 4.3,
    ) -> None:
        """volts: returns the mean voltage between two times [s]"""
        self._clock = clock
        self._volts = volts
        self._period = 1.0 / rate
        self._supply = supply
        self.conversions: list[tuple[float, int]] = []
        """Ends of the conversions that were read [s], and their gains."""
        self.level = 0
        """Level of PD_SCK."""
        self._rose = 0.0
        self._power_up()

    def _power_up(self) -> None:
        self._gain = 128
        self._pulses = 0
        self._down = False
        self._ready_at = self._clock.now + 4 * self._period  # settling time

    def clock_to(self, level: int) -> None:
        """Receive an edge of PD_SCK."""
        self._look()
        if level and not self.level:
            self._rose = self._clock.now
            if self._pulses or (not self._down and self._is_ready()):
                self._pulse()
        if self.level and not level and self._down:
            self._power_up()
        self.level = level

    def data(self) -> int:
        """Return the level of DOUT."""
        self._look()
        if self._down:
            return 1
        if not self._pulses:
            return int(not self._is_ready())
        if self._pulses <= 24:
            return self._code >> (24 - self._pulses) & 1
        return 1

    def _is_ready(self) -> bool:
        return self._clock.now >= self._ready_at

    def _look(self) -> None:
        """Apply events since the previous access: power-down, and the next conversion."""
        if self.level and self._clock.now - self._rose > POWER_DOWN:
            self._down = True
            self._pulses = 0
        elif self._pulses > 24 and not self.level and self._clock.now - self._rose > 1e-4:
            assert self._pulses in GAINS, f"{self._pulses} pulses"
            self._gain = GAINS[self._pulses]
            self._pulses = 0

    def _pulse(self) -> None:
        if self._pulses == 0:
            self._convert()
        self._pulses += 1
        assert self._pulses <= 27, "no more than 27 pulses may come in one go"
        if self._pulses == 25:
            behind = (self._clock.now - self._ready_at) // self._period
            self._ready_at += (behind + 1) * self._period  # conversions continued meanwhile

    def _convert(self) -> None:
        """Store the newest conversion, which is shifted out."""
        end = self._ready_at + (self._clock.now - self._ready_at) // self._period * self._period
        full_scale = 0.5 * self._supply / self._gain
        code = round(self._volts(end - self._period, end) / full_scale * STEPS)
        self._code = min(max(code, -STEPS), STEPS - 1) & 0xFFFFFF
        self.conversions.append((end, self._gain))


class GpioStandIn:
    """Module RPi.GPIO with chips on its pins; it can be imported within the context manager."""

    BCM, IN, OUT, LOW, HIGH, PUD_UP = 11, 1, 0, 0, 1, 22

    def __init__(self, clock: VirtualClock, sck: int, chips: dict[int, Hx711Chip]) -> None:
        """sck: pin of PD_SCK of all chips; chips: chips by the pin of DOUT"""
        self._clock = clock
        self._sck = sck
        self.chips = chips
        self.unplugged: set[int] = set()
        """Pins with a disconnected wire."""
        self.shorted: set[int] = set()
        """Pins connected to ground."""
        self.hold_up = 0.0
        """Delay of the program at the next rising edge [s]."""
        self.claimed: dict[int, int] = {}

    def setmode(self, mode: int) -> None:
        assert mode == self.BCM

    def setup(self, pin: int, direction: int, initial: int = 0, pull_up_down: int = 0) -> None:
        assert (direction == self.OUT) == (pin == self._sck)
        assert direction == self.OUT or pull_up_down == self.PUD_UP
        self.claimed[pin] = direction
        if direction == self.OUT:
            self.output(pin, initial)

    def output(self, pin: int, level: int) -> None:
        assert self.claimed[pin] == self.OUT
        self._clock.sleep(CALL)
        for chip in self.chips.values():
            chip.clock_to(level)
        if level and self.hold_up:
            self._clock.sleep(self.hold_up)
            self.hold_up = 0.0

    def input(self, pin: int) -> int:
        assert self.claimed[pin] == self.IN
        self._clock.sleep(CALL)
        if pin in self.shorted:
            return 0
        return 1 if pin in self.unplugged else self.chips[pin].data()

    def cleanup(self, pins: list[int]) -> None:
        for pin in pins:
            self.claimed.pop(pin)

    def __enter__(self) -> "GpioStandIn":
        package, module = ModuleType("RPi"), ModuleType("RPi.GPIO")
        for name in dir(self):
            if not name.startswith("_"):
                setattr(module, name, getattr(self, name))
        package.GPIO = module  # type: ignore[attr-defined]
        self._before = {name: sys.modules.get(name) for name in ("RPi", "RPi.GPIO")}
        sys.modules.update({"RPi": package, "RPi.GPIO": module})
        return self

    def __exit__(self, *_: object) -> None:
        for name, module in self._before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
