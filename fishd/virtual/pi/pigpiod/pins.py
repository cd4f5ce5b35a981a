"""GPIOs of the emulated pigpiod on a Pi 4: their modes, levels and pulses.

The PWM peripheral belongs to the Pi, not to pigpiod: its pulses and the modes of pins remain when
pigpiod ends.
"""

from enum import Enum, auto

from fishd.virtual.pi.pigpiod import errors
from fishd.virtual.pi.pigpiod.errors import check
from fishd.virtual.pi.pulse_train import PulseTrain

GPIO_COUNT = 32
"""Number of GPIOs."""
HEADER_GPIOS = range(2, 28)
"""GPIOs that a client may change on a Pi 4B."""
INPUT, OUTPUT = 0, 1
PERIPHERAL_MODES = {12: 4, 13: 4, 18: 2, 19: 2}
"""Mode in which the PWM peripheral drives a GPIO, by GPIO."""

PULSE_STEP_US = 5
"""Step to which servo and software PWM pulses are rounded down [µs]."""
PWM_RANGE, PWM_STEPS = 255, 250
"""Largest duty of software PWM, and the number of steps in a period at 800 Hz."""
HARDWARE_DUTY, HARDWARE_MAX_HZ = 1_000_000, 187_500_000
"""Largest duty of hardware PWM, and its largest frequency [Hz]."""
HARDWARE_CLOCK_HZ = 375_000_000
"""Clock frequency of the hardware PWM [Hz]."""


class Use(Enum):
    """Latest use of a GPIO that pigpiod has recorded."""

    NOTHING = auto()
    LEVEL = auto()
    PWM = auto()
    SERVO = auto()
    HARDWARE_PWM = auto()


class Pin:
    """State of one GPIO."""

    def __init__(self, gpio: int) -> None:
        self.use = Use.NOTHING
        self.mode = INPUT
        self.written = 0
        """Level that was written."""
        self.requested = 0
        """Width [µs] or duty that a client has requested."""
        self.train = PulseTrain()
        self._peripheral = PERIPHERAL_MODES.get(gpio)
        self._pull = int(gpio <= 8)  # at power-on, a Pi pulls GPIOs 0 to 8 up and all others down

    @property
    def connected(self) -> bool:
        """Whether the PWM peripheral drives the GPIO, also after a restart of pigpiod."""
        return self.mode == self._peripheral

    def level(self, time: float) -> int:
        """Return the level at a time [s]."""
        if self.connected:
            return self.train.level(time)
        return (self.written or self.train.level(time)) if self.mode == OUTPUT else self._pull

    def start_use(self, time: float, use: Use, requested: int = 0) -> None:
        """Start a use at a time [s]; pulses of another use or of the peripheral are cut off."""
        if self.use is not use or self.connected:
            if self.use in (Use.PWM, Use.SERVO) or self.connected:
                self.train.cut(time)
            self.use = use
        self.requested = requested


class Pins:
    """All GPIOs; each method is a command of pigpio and raises `PigpioError`.

    Times are seconds of the daemon's clock and must not decrease from call to call.
    """

    def __init__(self) -> None:
        self.pins = [Pin(gpio) for gpio in range(GPIO_COUNT)]

    def reset(self, time: float) -> None:
        """Reset as after a restart of the daemon.

        Modes and levels remain, and so do pulses of the PWM peripheral, unknown to pigpiod.
        """
        for pin in self.pins:
            if not pin.connected:
                pin.train.cut(time)
            pin.use, pin.requested = Use.NOTHING, 0

    def levels(self, time: float) -> int:
        """Return all levels as bits."""
        return sum(pin.level(time) << gpio for gpio, pin in enumerate(self.pins))

    def level(self, time: float, gpio: int) -> int:
        """Return the level of one GPIO."""
        return self._pin(gpio).level(time)

    def write(self, time: float, gpio: int, level: int) -> int:
        """Make a GPIO an output with a level; pulses end at once."""
        pin = self._pin(gpio, change=True)
        check(level <= 1, errors.BAD_LEVEL)
        pin.start_use(time, Use.LEVEL)
        pin.mode, pin.written = OUTPUT, level
        return 0

    def mode(self, gpio: int) -> int:
        """Return the mode: 0 input, 1 output, 2–7 alternative functions."""
        return self._pin(gpio).mode

    def set_mode(self, time: float, gpio: int, mode: int) -> int:
        """Set the mode; pulses end if it changes."""
        pin = self._pin(gpio, change=True)
        check(mode <= 7, errors.BAD_MODE)
        if mode != pin.mode:
            pin.start_use(time, Use.NOTHING)
            pin.mode = mode
        return 0

    def servo(self, time: float, gpio: int, width: int) -> int:
        """Send servo pulses [µs], 0: none; a running pulse is completed."""
        pin = self._pin(gpio, change=True)
        check(width == 0 or 500 <= width <= 2500, errors.BAD_PULSEWIDTH)
        pin.start_use(time, Use.SERVO, width)
        pin.mode, pin.written = OUTPUT, 0
        pin.train.set(time, width // PULSE_STEP_US * PULSE_STEP_US)
        return 0

    def servo_width(self, gpio: int) -> int:
        """Return the latest requested width [µs]."""
        pin = self._pin(gpio)
        check(pin.use is Use.SERVO, errors.NOT_SERVO_GPIO)
        return pin.requested

    def pwm(self, time: float, gpio: int, duty: int) -> int:
        """Start software PWM with a duty of 0 to 255; 0 cuts off a running pulse."""
        pin = self._pin(gpio, change=True)
        check(duty <= PWM_RANGE, errors.BAD_DUTYCYCLE)
        pin.start_use(time, Use.PWM, duty)
        pin.mode, pin.written = OUTPUT, 0
        if duty:
            pin.train.set(
                time,
                duty * PWM_STEPS // PWM_RANGE * PULSE_STEP_US,
                PWM_STEPS * PULSE_STEP_US * 1e-6,
            )
        else:
            pin.train.cut(time)
        return 0

    def hardware_pwm(self, time: float, gpio: int, frequency: int, duty: int) -> int:
        """Start hardware PWM: frequency [Hz], 0 for off, and duty in millionths."""
        pin = self._pin(gpio, change=True)
        check(gpio in PERIPHERAL_MODES, errors.NOT_HPWM_GPIO)
        check(duty <= HARDWARE_DUTY, errors.BAD_HPWM_DUTY)
        check(frequency <= HARDWARE_MAX_HZ, errors.BAD_HPWM_FREQ)
        if frequency:
            if pin.use is not Use.HARDWARE_PWM:
                pin.start_use(time, Use.HARDWARE_PWM)
                pin.mode = PERIPHERAL_MODES[gpio]
            pin.requested = duty
            ticks = int(HARDWARE_CLOCK_HZ / frequency + 0.5)
            width = duty * ticks // HARDWARE_DUTY / HARDWARE_CLOCK_HZ * 1e6
            pin.train.set(time, width, ticks / HARDWARE_CLOCK_HZ)
        elif pin.use is Use.HARDWARE_PWM:  # otherwise pigpiod does not know that the PWM is on
            pin.start_use(time, Use.NOTHING)
        return 0

    def duty(self, gpio: int) -> int:
        """Return the duty of software or hardware PWM."""
        pin = self._pin(gpio)
        check(pin.use in (Use.PWM, Use.HARDWARE_PWM), errors.NOT_PWM_GPIO)
        return pin.requested

    def _pin(self, gpio: int, *, change: bool = False) -> Pin:
        check(gpio < GPIO_COUNT, errors.BAD_USER_GPIO)
        check(not change or gpio in HEADER_GPIOS, errors.NOT_PERMITTED)
        return self.pins[gpio]
