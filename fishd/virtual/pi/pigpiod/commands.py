"""Commands of the emulated pigpiod, without its sockets, on the GPIOs of a Pi 4 and on scripts.

They are those of fishd, and of other programs that move a servo. All others are answered with −88,
unknown command, and logged.
"""

import logging
import random
import struct
from collections.abc import Callable
from enum import Enum, auto
from itertools import count

from fishd.virtual.pi.pigpiod import errors
from fishd.virtual.pi.pigpiod.errors import PigpioError, check
from fishd.virtual.pi.pigpiod.script import PARAMETER_COUNT, Script
from fishd.virtual.pi.pulse_train import Edge, PulseTrain

log = logging.getLogger(__name__)

VERSION = 79
"""Version of the library in Raspberry Pi OS, whose Python module is 1.78."""
OLD_VERSION, UNKNOWN_TO_OLD = 60, frozenset({"PROCU"})
"""Version of an older pigpiod, and the commands that it does not know."""
HARDWARE_REVISION = 0xC03112
"""Revision of a Raspberry Pi 4B with 4 GB."""
MAX_SCRIPTS = 32
"""Largest number of stored scripts."""

_NAMES = """
MODES MODEG PUD READ WRITE PWM PRS PFS SERVO WDOG BR1 BR2 BC1 BC2 BS1 BS2 TICK HWVER NO NB NP NC
PRG PFG PRRG HELP PIGPV WVCLR WVAG WVAS WVGO WVGOR WVBSY WVHLT WVSM WVSP WVSC TRIG PROC PROCD PROCR
PROCS SLRO SLR SLRC PROCP MICS MILS PARSE WVCRE WVDEL WVTX WVTXR WVNEW I2CO I2CC I2CRD I2CWD I2CWQ
I2CRS I2CWS I2CRB I2CWB I2CRW I2CWW I2CRK I2CWK I2CRI I2CWI I2CPC I2CPK SPIO SPIC SPIR SPIW SPIX
SERO SERC SERRB SERWB SERR SERW SERDA GDC GPW HC HP CF1 CF2 BI2CC BI2CO BI2CZ I2CZ WVCHA SLRI CGI
CSI FG FN NOIB WVTXM WVTAT PADS PADG FO FC FR FW FS FL SHELL BSPIC BSPIO BSPIX BSCX EVM EVT PROCU
WVCAP
"""
NAMES = _NAMES.split()
"""All commands of pigpio, by number."""

_STATUS = struct.Struct(f"<{PARAMETER_COUNT + 1}i")
_REPORT = struct.Struct("<HHII")
"""Report of a notification: sequence, flags, tick [µs], levels."""
JITTER_S = 1e-4
"""Largest delay of an edge by the fault pulse-jitter [s]."""
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


class Notification:
    """Reports of the edges of some GPIOs to one client."""

    def __init__(self, send: Callable[[bytes], None]) -> None:
        self.send = send
        self.mask = 0
        """GPIOs to report, as bits."""
        self.since = 0.0
        """End of the time that is reported [s]."""
        self.levels = 0
        self.sequence = 0


class Pins:
    """All GPIOs; each method is a command of pigpio and raises `PigpioError`.

    The PWM peripheral belongs to the Pi, not to pigpiod: its pulses and the modes of pins remain
    when pigpiod ends. Times are as in `Commands`.
    """

    def __init__(self) -> None:
        self.pins = [Pin(gpio) for gpio in range(GPIO_COUNT)]
        self.wires: dict[int, int] = {}
        """GPIOs that a wire connects to another one, by GPIO."""

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
        return sum(self.driver(gpio).level(time) << gpio for gpio in range(GPIO_COUNT))

    def driver(self, gpio: int) -> Pin:
        """Return the GPIO that drives this one: at the other end of a wire, or itself."""
        pin = self.pins[gpio]
        return self.pins[self.wires.get(gpio, gpio)] if pin.mode == INPUT else pin

    def level(self, time: float, gpio: int) -> int:
        """Return the level of one GPIO."""
        self._pin(gpio)
        return self.driver(gpio).level(time)

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
            width = duty * PWM_STEPS // PWM_RANGE * PULSE_STEP_US
            pin.train.set(time, width, PWM_STEPS * PULSE_STEP_US * 1e-6)
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


class Commands:
    """GPIOs and scripts of one pigpiod; not safe for use from several threads.

    Times are seconds of its clock and must not decrease from call to call.
    """

    def __init__(self) -> None:
        self.pins = pins = Pins()
        self._scripts: dict[int, Script] = {}
        self.notifications: dict[int, Notification] = {}
        """Notifications by handle."""
        self._random = random.Random(0)
        self.unknown: frozenset[str] = frozenset()
        """Names of the commands that it does not know, as an older version."""
        self._logged: set[int] = set()
        """Unknown commands that were logged."""
        self._handlers: dict[str, Callable[[float, int, int, bytes], int]] = {
            "MODES": lambda time, gpio, mode, _: pins.set_mode(time, gpio, mode),
            "MODEG": lambda time, gpio, _, __: pins.mode(gpio),
            "READ": lambda time, gpio, _, __: pins.level(time, gpio),
            "WRITE": lambda time, gpio, level, _: pins.write(time, gpio, level),
            "PWM": lambda time, gpio, duty, _: pins.pwm(time, gpio, duty),
            "SERVO": lambda time, gpio, width, _: pins.servo(time, gpio, width),
            "PIGPV": lambda _, __, ___, ____: OLD_VERSION if self.unknown else VERSION,
            "GDC": lambda time, gpio, _, __: pins.duty(gpio),
            "GPW": lambda time, gpio, _, __: pins.servo_width(gpio),
            "HP": lambda time, gpio, frequency, extension: pins.hardware_pwm(
                time, gpio, frequency, int.from_bytes(extension[:4], "little")
            ),
            "PROC": lambda time, _, __, text: self._store(time, text),
            "PROCD": lambda time, script, _, __: self._delete(script),
            "PROCR": lambda time, script, _, extension: self._script(script).start(
                time, _parameters(extension)
            ),
            "PROCU": lambda time, script, _, extension: self._script(script).update(
                _parameters(extension)
            ),
            # Clients read these answers as numbers, never as errors.
            "BR1": lambda time, _, __, ___: pins.levels(time),
            "BR2": lambda _, __, ___, ____: 0,
            "TICK": lambda time, _, __, ___: int(time * 1e6),
            "HWVER": lambda _, __, ___, ____: HARDWARE_REVISION,
            "NB": self._begin_notification,
            "NC": lambda _, handle, __, ___: self._end_notification(handle),
        }

    def restart(self, time: float) -> None:
        """Reset as after a restart: without pulses and scripts."""
        self.pins.reset(time)
        self._scripts.clear()
        self.notifications.clear()

    def open_notification(self, send: Callable[[bytes], None]) -> int:
        """Return the handle of new notifications for a client, which report no GPIOs yet."""
        handle = next(number for number in count() if number not in self.notifications)
        self.notifications[handle] = Notification(send)
        return handle

    def _begin_notification(self, time: float, handle: int, mask: int, _: bytes) -> int:
        check(handle in self.notifications, errors.BAD_HANDLE)
        notification = self.notifications[handle]
        notification.mask, notification.since = mask, time
        notification.levels = self.pins.levels(time)
        return 0

    def _end_notification(self, handle: int) -> int:
        check(self.notifications.pop(handle, None) is not None, errors.BAD_HANDLE)
        return 0

    def notify(self, time: float, jitter: bool) -> None:
        """Report the edges of pulses before a time [s], up to which the scripts have run.

        jitter: whether each edge is reported up to `JITTER_S` late
        """
        for notification in list(self.notifications.values()):
            changes: dict[Edge, int] = {}
            for gpio in range(GPIO_COUNT):
                if notification.mask >> gpio & 1:
                    for edge in self.pins.driver(gpio).train.edges(notification.since, time):
                        changes[edge] = changes.get(edge, 0) | 1 << gpio
            reports = b""
            for (when, level), bits in sorted(changes.items()):
                levels = notification.levels
                notification.levels = levels | bits if level else levels & ~bits
                late = self._random.uniform(0.0, JITTER_S) if jitter else 0.0
                tick = int((when + late) * 1e6) & 0xFFFFFFFF
                reports += _REPORT.pack(notification.sequence, 0, tick, notification.levels)
                notification.sequence = notification.sequence + 1 & 0xFFFF
            notification.since = time
            if reports:
                notification.send(reports)

    def resume(self, time: float) -> None:
        """Continue at a time [s] after a pause."""
        for script in self._scripts.values():
            script.time = max(script.time, time)

    def advance(self, time: float) -> None:
        """Run the scripts up to a time [s], in the order of time."""
        while due := sorted((s.time, n) for n, s in self._scripts.items() if s.time <= time):
            next_due = due[1][0] if len(due) > 1 else time
            self._scripts[due[0][1]].run(next_due)

    def execute(
        self, time: float, number: int, p1: int, p2: int, extension: bytes
    ) -> tuple[int, bytes]:
        """Execute a command at a time [s] up to which the scripts have run.

        Return the result, negative for an error, and the bytes that follow it.
        """
        name = NAMES[number] if number < len(NAMES) else "?"
        if name in self.unknown:
            return errors.UNKNOWN_COMMAND, b""
        try:
            if name == "PROCP":
                script = self._script(p1)
                return _STATUS.size, _STATUS.pack(script.state(time), *script.parameters)
            if name in self._handlers:
                return self._handlers[name](time, p1, p2, extension), b""
        except PigpioError as error:
            return error.number, b""
        if number not in self._logged and len(self._logged) < len(NAMES):
            self._logged.add(number)
            log.warning(
                "emulated pigpiod: command %s (%d) is not emulated; "
                "docs/how-to/virtual-pi.md has a table",
                *(name, number),
            )
        return errors.UNKNOWN_COMMAND, b""

    def _store(self, time: float, text: bytes) -> int:
        script = Script(text.partition(b"\0")[0].decode("latin-1"), self._servo, time)
        number = next(number for number in count() if number not in self._scripts)
        check(number < MAX_SCRIPTS, errors.NO_SCRIPT_ROOM)
        self._scripts[number] = script
        return number

    def _delete(self, number: int) -> int:
        self._script(number)
        del self._scripts[number]
        return 0

    def _script(self, number: int) -> Script:
        check(number in self._scripts, errors.BAD_SCRIPT_ID)
        return self._scripts[number]

    def _servo(self, time: float, gpio: int, width: int) -> int:
        try:
            return self.pins.servo(time, gpio, width)
        except PigpioError as error:
            return error.number


def _parameters(extension: bytes) -> tuple[int, ...]:
    check(len(extension) // 4 <= PARAMETER_COUNT, errors.TOO_MANY_PARAM)
    return struct.unpack(f"<{len(extension) // 4}i", extension[: len(extension) // 4 * 4])
