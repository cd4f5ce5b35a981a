"""`hx711`: two load cells, each on an HX711, with one clock line for both.

What the chip does is from its data sheet: Avia Semiconductor, "HX711, 24-Bit Analog-to-Digital
Converter (ADC) for Weigh Scales". A falling DOUT says that a conversion is done. Then 24 pulses of
PD_SCK shift it out, most significant bit first, in two's complement, and one to three more choose
gain and input of the next one. A PD_SCK that stays high for more than 60 µs switches the chip off;
when it is low again, the chip starts anew with a gain of 128.
"""

from typing import Annotated, Literal

from fishd.hardware import header
from fishd.hardware.driver import (
    Check,
    Claim,
    Clock,
    ForceSensorDriver,
    ForceSensorSettings,
    Gpio,
    Machine,
    Pair,
    Problem,
    Result,
    note,
    pin,
    unit,
)

PULSES = {128: 25, 64: 27}
"""Pulses of PD_SCK that choose a gain of channel A; 26 would choose channel B."""
SETTLING = {10: 0.4, 80: 0.05}
"""After a start, output is valid only from then on, by rate [s]."""
LONGEST_HIGH = 50e-6
"""PD_SCK may be high for so long; from 60 µs on it is a power-down [s]."""
POWER_DOWN = 100e-6
STEPS = 1 << 23
SILENCE = 2.5
"""So many times the time of a conversion, and none is done: fishd is told before its next ticks."""
LOOK = 1e-3
"""Between two looks at DOUT [s]."""


class Hx711Settings(ForceSensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the two chips are wired."""

    clock: Annotated[Gpio, note("Pin of PD_SCK, of both chips.")] = 5
    data_x: Annotated[Gpio, note("Pin of DOUT of the chip that measures F_x.")] = 6
    data_y: Annotated[Gpio, note("Pin of DOUT of the chip that measures F_y.")] = 13
    gain: Annotated[Literal[128, 64], note("Of channel A.")] = 128
    rate: Annotated[Literal[10, 80], unit("1/s", "By pin RATE: 10 at ground, 80 at DVDD.")] = 80
    supply: Annotated[float, unit("V", "AVDD, which feeds the load cells.", ge=2.6, le=5.5)] = 4.3


class Hx711(ForceSensorDriver[Hx711Settings]):
    """Two load cells on HX711 chips, bit by bit through RPi.GPIO."""

    Settings = Hx711Settings
    packages = (header.PACKAGE,)
    place = "the HX711 chips"

    def __init__(self, settings: Hx711Settings, clock: Clock) -> None:
        """Raises `StartupError` if RPi.GPIO is missing; opens nothing yet."""
        super().__init__(settings, clock)
        self.names = f"F_x (GPIO {settings.data_x})", f"F_y (GPIO {settings.data_y})"
        self._gpio = header.load()
        self._data = (settings.data_x, settings.data_y)
        self._volts = 0.5 * settings.supply / settings.gain / STEPS  # of one step, at the input
        self._open = False

    def open(self) -> None:
        """Claim the pins, and start the chips anew."""
        gpio = self._gpio
        for data in self._data:
            # Without a chip the line is high, as during a conversion that never ends.
            header.claim(gpio, data, gpio.IN, pull_up_down=gpio.PUD_UP)
        header.claim(gpio, self.settings.clock, gpio.OUT, initial=gpio.LOW)
        self._open = True
        gpio.output(self.settings.clock, gpio.HIGH)
        self.clock.sleep(POWER_DOWN)
        gpio.output(self.settings.clock, gpio.LOW)
        self._started()

    def sample(self) -> Pair | None:
        """A pair, once both chips have one; looks once, and waits a millisecond where not."""
        now = self.clock.monotonic()
        waiting = [data for data in self._data if self._gpio.input(data)]
        if waiting:
            if now - max(self._latest, self._valid_from) > SILENCE / self.settings.rate:
                raise TimeoutError(
                    f"no data from the HX711 on GPIO {waiting[0]}: check its power and wires"
                )
            self.clock.sleep(LOOK)
            return None
        x, y = self._shift()
        if not all(map(self._gpio.input, self._data)):
            raise OSError("an HX711 still says that data is ready: is its DOUT shorted to ground?")
        self._latest = now
        if self._lost:
            self._started()
            return None
        first, self._first = self._first, False
        if first or now < self._valid_from:  # the first one is of another gain
            return None
        clipped = next(
            (
                f"{name} is at the end of its range"
                for name, code in zip(self.names, (x, y), strict=True)
                if code in (-STEPS, STEPS - 1)
            ),
            "",
        )
        return Pair(now - 1 / self.settings.rate, now, x * self._volts, y * self._volts, clipped)

    def close(self) -> None:
        """Let go of the pins."""
        if self._open:
            self._open = False
            self._gpio.cleanup([self.settings.clock, *self._data])

    @classmethod
    def pair_rate(cls, settings: Hx711Settings) -> float:
        """The chip's oscillator may be 10 % slow."""
        return 0.9 * settings.rate

    @classmethod
    def check(cls, settings: Hx711Settings, tick: float) -> None:
        """Three different pins, and a pair in each tick."""
        if settings.data_x == settings.data_y:
            raise Problem(("data_y",), f"{settings.data_y} is the pin of data_x already")
        if 1.1 / settings.rate > tick:
            raise Problem(
                ("rate",),
                f"{settings.rate} is not valid: a sample takes up to {1100 / settings.rate:.0f} "
                f"ms, longer than a tick of {tick * 1e3:g} ms",
            )

    @classmethod
    def claims(cls, settings: Hx711Settings) -> tuple[Claim, ...]:
        """Its three pins."""
        return tuple(
            pin(gpio, f"HX711's {name}", key)
            for name, key, gpio in (
                ("PD_SCK", "clock", settings.clock),
                ("DOUT of F_x", "data_x", settings.data_x),
                ("DOUT of F_y", "data_y", settings.data_y),
            )
        )

    @classmethod
    def checks(cls, settings: Hx711Settings) -> tuple[Check, ...]:
        """Whether the range fits."""
        return (Check("load cells", lambda machine: load_cells(machine, settings)),)

    def _started(self) -> None:
        """The chips have just been started: their gain is 128, and they have to settle."""
        self._latest = self.clock.monotonic()
        self._valid_from = self._latest + SETTLING[self.settings.rate]
        self._first = True
        self._lost = False

    def _shift(self) -> tuple[int, int]:
        """The codes of both chips; `_lost` where a pulse was so long that it was a power-down."""
        gpio, clock, sck = self._gpio, self.clock.monotonic, self.settings.clock
        data_x, data_y = self._data
        x = y = 0
        for pulse in range(PULSES[self.settings.gain]):
            begun = clock()
            gpio.output(sck, gpio.HIGH)
            gpio.output(sck, gpio.LOW)
            self._lost |= clock() - begun > LONGEST_HIGH
            if pulse < 24:
                x = x << 1 | gpio.input(data_x)
                y = y << 1 | gpio.input(data_y)
        return _signed(x), _signed(y)


def _signed(code: int) -> int:
    return code - 2 * STEPS if code >= STEPS else code


def load_cells(machine: Machine, settings: Hx711Settings) -> Result:
    """What the range is, at the input of the chips."""
    most = 500 * settings.supply / settings.gain
    return Result("ok", f"±{most:.1f} mV at a gain of {settings.gain}, {settings.rate} per second")
