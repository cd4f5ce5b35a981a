"""The GPIOs of the emulated pigpiod on a Pi 4: their modes and levels, and what sends pulses where.

The PWM peripheral is the Pi's, not pigpiod's: its pulses and the modes of pins outlive pigpiod.
"""

from enum import Enum, auto

from fishd.virtual.pi.pigpiod import errors
from fishd.virtual.pi.pigpiod.errors import check
from fishd.virtual.pi.pulse_train import PulseTrain

GPIOS = 32
HEADER = range(2, 28)
"""The GPIOs that a Pi 4B lets a client change."""
INPUT, OUTPUT = 0, 1
PERIPHERAL = {12: 4, 13: 4, 18: 2, 19: 2}
"""GPIO → the mode in which the PWM peripheral drives it."""

STEP = 5
"""Servo and software PWM pulses are rounded down to multiples of this [µs]."""
PWM_RANGE, PWM_STEPS = 255, 250
"""Largest duty of software PWM, and the steps of a period, at its 800 Hz."""
HARDWARE_DUTY, HARDWARE_FASTEST = 1_000_000, 187_500_000
"""Largest duty of hardware PWM, and its largest frequency [Hz]."""
HARDWARE_CLOCK = 375_000_000
"""Ticks of the hardware PWM in a second."""


class Use(Enum):
    """What pigpiod knows that a GPIO was last told to do."""

    NOTHING = auto()
    LEVEL = auto()
    PWM = auto()
    SERVO = auto()
    HARDWARE_PWM = auto()


class Pin:
    """One GPIO."""

    def __init__(self, gpio: int) -> None:
        self.use = Use.NOTHING
        self.mode = INPUT
        self.written = 0
        """The level that it was set to."""
        self.asked = 0
        """The width [µs] or duty that a client asked for."""
        self.train = PulseTrain()
        self._peripheral = PERIPHERAL.get(gpio)
        self._pull = int(gpio <= 8)  # at power-on a Pi pulls the low ones up and all others down

    @property
    def connected(self) -> bool:
        """Whether the PWM peripheral drives it, whoever wanted that."""
        return self.mode == self._peripheral

    def level(self, time: float) -> int:
        """The level at a time [s]."""
        if self.connected:
            return self.train.level(time)
        return (self.written or self.train.level(time)) if self.mode == OUTPUT else self._pull

    def turn_to(self, time: float, use: Use, asked: int = 0) -> None:
        """Begin a use [s]; what sent pulses for another one, the peripheral too, is cut off."""
        if self.use is not use or self.connected:
            if self.use in (Use.PWM, Use.SERVO) or self.connected:
                self.train.cut(time)
            self.use = use
        self.asked = asked


class Pins:
    """All GPIOs; each method is a command of pigpio and raises `PigpioError`.

    Times are seconds of the daemon's clock and must not go back from call to call.
    """

    def __init__(self) -> None:
        self.pins = [Pin(gpio) for gpio in range(GPIOS)]

    def reset(self, time: float) -> None:
        """What a new daemon finds: no pulses but those of the PWM peripheral, of which it does not
        know; modes and levels as they were.
        """
        for pin in self.pins:
            if not pin.connected:
                pin.train.cut(time)
            pin.use, pin.asked = Use.NOTHING, 0

    def levels(self, time: float) -> int:
        """All levels as bits."""
        return sum(pin.level(time) << gpio for gpio, pin in enumerate(self.pins))

    def level(self, time: float, gpio: int) -> int:
        """Read one GPIO."""
        return self._pin(gpio).level(time)

    def write(self, time: float, gpio: int, level: int) -> int:
        """Make it an output of this level; ends pulses at once."""
        pin = self._pin(gpio, change=True)
        check(level <= 1, errors.BAD_LEVEL)
        pin.turn_to(time, Use.LEVEL)
        pin.mode, pin.written = OUTPUT, level
        return 0

    def mode(self, gpio: int) -> int:
        """The mode, 0 input, 1 output, 2–7 the alternative functions."""
        return self._pin(gpio).mode

    def set_mode(self, time: float, gpio: int, mode: int) -> int:
        """Change the mode; ends pulses if it is another one."""
        pin = self._pin(gpio, change=True)
        check(mode <= 7, errors.BAD_MODE)
        if mode != pin.mode:
            pin.turn_to(time, Use.NOTHING)
            pin.mode = mode
        return 0

    def servo(self, time: float, gpio: int, width: int) -> int:
        """Servo pulses [µs], 0 for none; the pulse under way is completed."""
        pin = self._pin(gpio, change=True)
        check(width == 0 or 500 <= width <= 2500, errors.BAD_PULSEWIDTH)
        pin.turn_to(time, Use.SERVO, width)
        pin.mode, pin.written = OUTPUT, 0
        pin.train.set(time, width // STEP * STEP)
        return 0

    def servo_width(self, gpio: int) -> int:
        """The width last asked for [µs]."""
        pin = self._pin(gpio)
        check(pin.use is Use.SERVO, errors.NOT_SERVO_GPIO)
        return pin.asked

    def pwm(self, time: float, gpio: int, duty: int) -> int:
        """Software PWM of this duty out of 255; 0 cuts a pulse short."""
        pin = self._pin(gpio, change=True)
        check(duty <= PWM_RANGE, errors.BAD_DUTYCYCLE)
        pin.turn_to(time, Use.PWM, duty)
        pin.mode, pin.written = OUTPUT, 0
        if duty:
            pin.train.set(time, duty * PWM_STEPS // PWM_RANGE * STEP, PWM_STEPS * STEP * 1e-6)
        else:
            pin.train.cut(time)
        return 0

    def hardware_pwm(self, time: float, gpio: int, frequency: int, duty: int) -> int:
        """Hardware PWM: frequency [Hz], 0 for off, and duty in millionths."""
        pin = self._pin(gpio, change=True)
        check(gpio in PERIPHERAL, errors.NOT_HPWM_GPIO)
        check(duty <= HARDWARE_DUTY, errors.BAD_HPWM_DUTY)
        check(frequency <= HARDWARE_FASTEST, errors.BAD_HPWM_FREQ)
        if frequency:
            if pin.use is not Use.HARDWARE_PWM:
                pin.turn_to(time, Use.HARDWARE_PWM)
                pin.mode = PERIPHERAL[gpio]
            pin.asked = duty
            ticks = int(HARDWARE_CLOCK / frequency + 0.5)
            width = duty * ticks // HARDWARE_DUTY / HARDWARE_CLOCK * 1e6
            pin.train.set(time, width, ticks / HARDWARE_CLOCK)
        elif pin.use is Use.HARDWARE_PWM:  # else it does not know that it is on
            pin.turn_to(time, Use.NOTHING)
        return 0

    def duty(self, gpio: int) -> int:
        """The duty of software or hardware PWM."""
        pin = self._pin(gpio)
        check(pin.use in (Use.PWM, Use.HARDWARE_PWM), errors.NOT_PWM_GPIO)
        return pin.asked

    def _pin(self, gpio: int, *, change: bool = False) -> Pin:
        check(gpio < GPIOS, errors.BAD_USER_GPIO)
        check(not change or gpio in HEADER, errors.NOT_PERMITTED)
        return self.pins[gpio]
