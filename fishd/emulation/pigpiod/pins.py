"""The GPIOs as pigpiod keeps them on a Pi 4: modes, pulls, levels, and what sends pulses where.

The PWM peripheral is the Pi's, not pigpiod's: its registers and the modes of pins outlive pigpiod.
"""

from dataclasses import dataclass, replace

from fishd.emulation.pigpiod import errors
from fishd.emulation.pigpiod.errors import PigpioError
from fishd.emulation.pigpiod.pin import OUTPUT, PULL_UP, Pin, Use

GPIOS, USER_GPIOS = 54, 32
PERMITTED = 0x0FFFFFFC
"""The GPIOs that a Pi 4B lets a client change, as a mask: 2 to 27, its header."""
HARDWARE_PWM = {12: (0, 4), 13: (1, 4), 18: (0, 2), 19: (1, 2)}
"""GPIO → its channel of the hardware PWM and the mode that connects it."""
HARDWARE_DUTY = 1_000_000
HARDWARE_CLOCK = 375_000_000
"""Ticks of the hardware PWM in a second, on a Pi 4."""
HARDWARE_FASTEST = 187_500_000
_CYCLES = (1, 2, 4, 5, 8, 10, 16, 20, 25, 32, 40, 50, 80, 100, 160, 200, 400, 800)
REAL_RANGES = tuple(25 * cycles for cycles in _CYCLES)
"""Steps in a period, for each frequency that software PWM can have."""


@dataclass(frozen=True)
class Channel:
    """The registers of one channel of the PWM peripheral."""

    frequency: int = 0
    duty: int = 0
    steps: int = 1
    enabled: bool = False


class Pins:
    """All GPIOs of a Pi; each method is a command of pigpio and raises `PigpioError`.

    Times are seconds of the daemon's clock and must not go back from call to call.
    """

    def __init__(self, step: int) -> None:
        """`step`: what pulses are rounded down to [µs], as with `pigpiod -s`."""
        self._step = step
        self._frequencies = {
            round(1e6 / (steps * step)): steps for steps in sorted(REAL_RANGES, reverse=True)
        }
        idle = self._real_range(800)
        self.pins = [self._pin(gpio, idle) for gpio in range(GPIOS)]
        self._channels = [Channel(), Channel()]

    def reset(self, time: float) -> None:
        """What a new daemon finds: no pulses but those of the PWM peripheral, of which it does not
        know; modes, pulls and levels as they were.
        """
        for gpio, pin in enumerate(self.pins):
            if not pin.connected:
                pin.train.cut(time)
            fresh = self._pin(gpio, self._real_range(800))
            fresh.mode, fresh.pull, fresh.latch = pin.mode, pin.pull, pin.latch
            fresh.train = pin.train
            self.pins[gpio] = fresh

    def level(self, time: float, gpio: int) -> int:
        """Read one GPIO."""
        return self._any(gpio).level(time)

    def levels(self, time: float, bank: int) -> int:
        """Read GPIO 0–31 (bank 0) or 32–53 (bank 1) as bits."""
        pins = self.pins[32 * bank : 32 * bank + 32]
        return sum(pin.level(time) << bit for bit, pin in enumerate(pins))

    def get_mode(self, gpio: int) -> int:
        """The mode, 0 input, 1 output, 2–7 the alternative functions."""
        return self._any(gpio).mode

    def set_mode(self, time: float, gpio: int, mode: int) -> int:
        """Change the mode; ends pulses if it is another one."""
        pin = self._any(gpio, change=True)
        _check(mode <= 7, errors.BAD_MODE)
        if mode != pin.mode:
            self._use(time, pin, Use.NOTHING)
            pin.mode = mode
            if pin.connected:
                self._drive(time, HARDWARE_PWM[gpio][0])
        return 0

    def set_pull(self, gpio: int, pull: int) -> int:
        """0 off, 1 down, 2 up."""
        pin = self._any(gpio, change=True)
        _check(pull <= PULL_UP, errors.BAD_PUD)
        pin.pull = pull
        return 0

    def write(self, time: float, gpio: int, level: int) -> int:
        """Make it an output of this level; ends pulses at once."""
        pin = self._any(gpio, change=True)
        _check(level <= 1, errors.BAD_LEVEL)
        self._use(time, pin, Use.WRITE)
        pin.mode, pin.latch = OUTPUT, level
        return 0

    def write_bank(self, bank: int, bits: int, level: int) -> int:
        """Set the level of the outputs among these bits, leaving modes alone."""
        permitted = (PERMITTED >> (32 * bank)) & 0xFFFFFFFF
        for bit in range(32):
            if bits & permitted & 1 << bit:
                self.pins[32 * bank + bit].latch = level
        _check(bits & ~permitted == 0, errors.SOME_PERMITTED)
        return 0

    def trigger(self, gpio: int, length: int, level: int) -> int:
        """Check the arguments of a trigger pulse, which leaves the pin at the other level."""
        pin = self._user(gpio, change=True)
        _check(level <= 1, errors.BAD_LEVEL)
        _check(1 <= length <= 100, errors.BAD_PULSELEN)
        pin.latch = level
        return 0

    def servo(self, time: float, gpio: int, width: int) -> int:
        """Servo pulses [µs], 0 for none; the pulse under way is completed."""
        pin = self._user(gpio, change=True)
        _check(width == 0 or 500 <= width <= 2500, errors.BAD_PULSEWIDTH)
        self._use(time, pin, Use.SERVO)
        pin.mode, pin.width, pin.latch = OUTPUT, width, 0
        pin.train.set(time, width // self._step * self._step)
        return 0

    def servo_width(self, gpio: int) -> int:
        """The width last asked for [µs]."""
        pin = self._user(gpio)
        _check(pin.use is Use.SERVO, errors.NOT_SERVO_GPIO)
        return pin.width

    def pwm(self, time: float, gpio: int, duty: int) -> int:
        """Software PWM of this duty, out of the GPIO's range; 0 cuts a pulse short."""
        pin = self._user(gpio, change=True)
        _check(duty <= pin.duty_range, errors.BAD_DUTYCYCLE)
        self._use(time, pin, Use.PWM)
        pin.mode, pin.width, pin.latch = OUTPUT, duty, 0
        self._send_pwm(time, pin)
        return 0

    def duty(self, gpio: int) -> int:
        """The duty of software or hardware PWM."""
        pin = self._user(gpio)
        if pin.use is Use.HARDWARE_PWM:
            return self._channel(gpio).duty
        _check(pin.use is Use.PWM, errors.NOT_PWM_GPIO)
        return pin.width

    def set_range(self, time: float, gpio: int, duty_range: int) -> int:
        """Set the largest duty; gives the steps that a period really has."""
        pin = self._user(gpio, change=True)
        _check(25 <= duty_range <= 40_000, errors.BAD_DUTYRANGE)
        if pin.use is Use.PWM:
            pin.width = duty_range * pin.width // pin.duty_range
        pin.duty_range = duty_range
        self._send_pwm(time, pin)
        return pin.real_range

    def get_range(self, gpio: int) -> int:
        """The largest duty."""
        pin = self._user(gpio)
        return HARDWARE_DUTY if pin.use is Use.HARDWARE_PWM else pin.duty_range

    def real_range(self, gpio: int) -> int:
        """The steps that a period really has."""
        pin = self._user(gpio)
        return self._channel(gpio).steps if pin.use is Use.HARDWARE_PWM else pin.real_range

    def set_frequency(self, time: float, gpio: int, frequency: int) -> int:
        """Take the nearest frequency that there is [Hz], and give it."""
        pin = self._user(gpio, change=True)
        pin.real_range = self._real_range(frequency)
        self._send_pwm(time, pin)
        return self._frequency(pin)

    def frequency(self, gpio: int) -> int:
        """The frequency of its PWM [Hz]."""
        pin = self._user(gpio)
        known = pin.use is Use.HARDWARE_PWM
        return self._channel(gpio).frequency if known else self._frequency(pin)

    def hardware_pwm(self, time: float, gpio: int, frequency: int, duty: int) -> int:
        """Hardware PWM: frequency [Hz], 0 for off, and duty in millionths."""
        pin = self._any(gpio, change=True)
        _check(gpio in HARDWARE_PWM, errors.NOT_HPWM_GPIO)
        _check(duty <= HARDWARE_DUTY, errors.BAD_HPWM_DUTY)
        _check(frequency <= HARDWARE_FASTEST, errors.BAD_HPWM_FREQ)
        number, mode = HARDWARE_PWM[gpio]
        if frequency:
            steps = int(HARDWARE_CLOCK / frequency + 0.5)
            told = int(HARDWARE_CLOCK / steps + 0.5)
            self._channels[number] = Channel(told, duty, steps, enabled=True)
            if pin.use is not Use.HARDWARE_PWM:
                self._use(time, pin, Use.HARDWARE_PWM)
                pin.mode = mode
            self._drive(time, number)
        elif pin.use is Use.HARDWARE_PWM:  # else it does not know that it is on
            pin.use = Use.NOTHING
            self._channels[number] = replace(self._channels[number], enabled=False)
            self._drive(time, number)
        return 0

    def _drive(self, time: float, number: int) -> None:
        """Let the pins that are connected to a channel of the peripheral send what it makes."""
        channel = self._channels[number]
        width = channel.duty * channel.steps // HARDWARE_DUTY / HARDWARE_CLOCK * 1e6
        for gpio, (its_number, _) in HARDWARE_PWM.items():
            pin = self.pins[gpio]
            if its_number != number or not pin.connected:
                continue
            if channel.enabled:
                pin.train.set(time, width, channel.steps / HARDWARE_CLOCK)
            else:
                pin.train.cut(time)

    def _use(self, time: float, pin: Pin, use: Use) -> None:
        """Begin another use; what sent pulses until now ends, the peripheral behind the pin too."""
        if pin.use is use and not pin.connected:
            return
        if pin.use in (Use.PWM, Use.SERVO) or pin.connected:
            pin.train.cut(time)
        pin.use, pin.width = use, 0

    @staticmethod
    def _pin(gpio: int, idle_range: int) -> Pin:
        return Pin(gpio, idle_range, HARDWARE_PWM[gpio][1] if gpio in HARDWARE_PWM else None)

    def _send_pwm(self, time: float, pin: Pin) -> None:
        if pin.use is not Use.PWM:
            return
        period = pin.real_range * self._step
        width = pin.width * pin.real_range // pin.duty_range * self._step
        if width:
            pin.train.set(time, width, period * 1e-6)
        else:
            pin.train.cut(time)

    def _real_range(self, frequency: int) -> int:
        nearest = min(self._frequencies, key=lambda known: (abs(known - frequency), -known))
        return self._frequencies[nearest]

    def _frequency(self, pin: Pin) -> int:
        return int(1e6 / (pin.real_range * self._step) + 0.5)

    def _channel(self, gpio: int) -> Channel:
        return self._channels[HARDWARE_PWM[gpio][0]]

    def _any(self, gpio: int, *, change: bool = False) -> Pin:
        _check(not change or gpio >= GPIOS or bool(PERMITTED >> gpio & 1), errors.NOT_PERMITTED)
        _check(gpio < GPIOS, errors.BAD_GPIO)
        return self.pins[gpio]

    def _user(self, gpio: int, *, change: bool = False) -> Pin:
        _check(gpio < USER_GPIOS or (change and gpio < GPIOS), errors.BAD_USER_GPIO)
        return self._any(gpio, change=change)


def _check(good: bool, error: int) -> None:
    if not good:
        raise PigpioError(error)
