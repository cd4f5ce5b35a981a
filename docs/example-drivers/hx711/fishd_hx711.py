"""`hx711`: two load cells, each on an HX711, with one clock line for both.

The protocol is from the data sheet: Avia Semiconductor, "HX711, 24-Bit Analog-to-Digital Converter
(ADC) for Weigh Scales". DOUT falls when a conversion is complete. Then 24 pulses of PD_SCK shift
the result out, most significant bit first, in two's complement, and one to three more pulses select
gain and input of the next conversion. If PD_SCK stays high for more than 60 µs, the chip switches
off; when PD_SCK is low again, the chip starts with a gain of 128.
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
"""Number of pulses of PD_SCK by gain of channel A; 26 would select channel B."""
SETTLING_S = {10: 0.4, 80: 0.05}
"""Time from a start to the first valid output, by rate [s]."""
MAX_HIGH_S = 50e-6
"""Longest permitted pulse of PD_SCK; 60 µs switch the chip off [s]."""
POWER_DOWN_S = 100e-6
"""Length of the pulse of PD_SCK that switches the chips off [s]."""
STEPS = 1 << 23
"""Number of steps from zero to the end of the range."""
MAX_SILENT_SAMPLES = 2.5
"""Number of conversion times without a result after which `sample` raises an error."""
POLL_INTERVAL_S = 1e-3
"""Time between two reads of DOUT [s]."""


class Hx711Settings(ForceSensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Wiring of the two chips."""

    clock: Annotated[Gpio, note("Pin of PD_SCK, of both chips.")] = 5
    data_x: Annotated[Gpio, note("Pin of DOUT of the chip that measures F_x.")] = 6
    data_y: Annotated[Gpio, note("Pin of DOUT of the chip that measures F_y.")] = 13
    gain: Annotated[Literal[128, 64], note("Gain of channel A.")] = 128
    rate: Annotated[Literal[10, 80], unit("1/s", "Set by pin RATE: 10 at ground, 80 at DVDD.")] = 80
    supply: Annotated[float, unit("V", "Supply AVDD of the load cells.", ge=2.6, le=5.5)] = 4.3


class Hx711(ForceSensorDriver[Hx711Settings]):
    """Driver of two load cells on HX711 chips, which reads them bit by bit through RPi.GPIO."""

    Settings = Hx711Settings
    packages = (header.PACKAGE,)
    place = "the HX711 chips"

    def __init__(self, settings: Hx711Settings, clock: Clock) -> None:
        """Load RPi.GPIO without opening a pin; raise `StartupError` if it is missing."""
        super().__init__(settings, clock)
        self.names = f"F_x (GPIO {settings.data_x})", f"F_y (GPIO {settings.data_y})"
        self._gpio = header.load()
        self._data = (settings.data_x, settings.data_y)
        self._volts = 0.5 * settings.supply / settings.gain / STEPS  # input voltage of one step
        self._open = False

    def open(self) -> None:
        """Claim the pins and restart the chips."""
        gpio = self._gpio
        for data in self._data:
            # Without a chip the line stays high, as during a conversion.
            header.claim(gpio, data, gpio.IN, pull_up_down=gpio.PUD_UP)
        header.claim(gpio, self.settings.clock, gpio.OUT, initial=gpio.LOW)
        self._open = True
        gpio.output(self.settings.clock, gpio.HIGH)
        self.clock.sleep(POWER_DOWN_S)
        gpio.output(self.settings.clock, gpio.LOW)
        self._begin_settling()

    def sample(self) -> Pair | None:
        """Return a pair if both chips have one; otherwise wait a millisecond and return None."""
        now = self.clock.monotonic()
        waiting = [data for data in self._data if self._gpio.input(data)]
        if waiting:
            if now - max(self._latest, self._valid_from) > MAX_SILENT_SAMPLES / self.settings.rate:
                raise TimeoutError(
                    f"no data from the HX711 on GPIO {waiting[0]}: check its power and wires"
                )
            self.clock.sleep(POLL_INTERVAL_S)
            return None
        x, y = self._read_codes()
        if not all(map(self._gpio.input, self._data)):
            raise OSError("an HX711 still says that data is ready: is its DOUT shorted to ground?")
        self._latest = now
        if self._powered_down:
            self._begin_settling()
            return None
        is_first, self._first = self._first, False
        if is_first or now < self._valid_from:  # the first result has another gain
            return None
        clipped = next(
            (
                f"{name} is at the end of its range"
                for name, code in zip(self.names, (x, y), strict=True)
                if code in (-STEPS, STEPS - 1)
            ),
            None,
        )
        return Pair(now - 1 / self.settings.rate, now, x * self._volts, y * self._volts, clipped)

    def close(self) -> None:
        """Release the pins."""
        if self._open:
            self._open = False
            self._gpio.cleanup([self.settings.clock, *self._data])

    @classmethod
    def pair_rate(cls, settings: Hx711Settings) -> float:
        """Return 90 % of the rate, as the chip's oscillator may be 10 % slow."""
        return 0.9 * settings.rate

    @classmethod
    def check(cls, settings: Hx711Settings, tick: float) -> None:
        """Require different data pins, and time for a pair in each tick."""
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
        """Return claims of the three pins."""
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
        """Return the check that shows the measuring range."""
        return (Check("load cells", lambda machine: show_range(machine, settings)),)

    def _begin_settling(self) -> None:
        """Start the settling time after a start of the chips, which sets their gain to 128."""
        self._latest = self.clock.monotonic()
        self._valid_from = self._latest + SETTLING_S[self.settings.rate]
        self._first = True
        self._powered_down = False

    def _read_codes(self) -> tuple[int, int]:
        """Return the codes of both chips; set `_powered_down` if a pulse was too long."""
        gpio, clock, sck = self._gpio, self.clock.monotonic, self.settings.clock
        data_x, data_y = self._data
        x = y = 0
        for pulse in range(PULSES[self.settings.gain]):
            start = clock()
            gpio.output(sck, gpio.HIGH)
            gpio.output(sck, gpio.LOW)
            self._powered_down |= clock() - start > MAX_HIGH_S
            if pulse < 24:
                x = x << 1 | gpio.input(data_x)
                y = y << 1 | gpio.input(data_y)
        return _to_signed(x), _to_signed(y)


def _to_signed(code: int) -> int:
    return code - 2 * STEPS if code >= STEPS else code


def show_range(machine: Machine, settings: Hx711Settings) -> Result:
    """Report the range at the input of the chips."""
    limit = 500 * settings.supply / settings.gain
    return Result("ok", f"±{limit:.1f} mV at a gain of {settings.gain}, {settings.rate} per second")
