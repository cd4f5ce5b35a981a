"""Commands of the emulated pigpiod, without its sockets.

They are those of fishd, and those that move a servo with `pigs`. All others are answered with −88,
unknown command, and logged.
"""

import logging
import struct
from collections.abc import Callable
from itertools import count

from fishd.virtual.pi.pigpiod import errors
from fishd.virtual.pi.pigpiod.errors import PigpioError, check
from fishd.virtual.pi.pigpiod.pins import Pins
from fishd.virtual.pi.pigpiod.script import PARAMETER_COUNT, Script

log = logging.getLogger(__name__)

VERSION = 79
"""Version of the library in Raspberry Pi OS, whose Python module is 1.78."""
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


class Commands:
    """GPIOs and scripts of one pigpiod; not safe for use from several threads.

    Times are seconds of its clock and must not decrease from call to call.
    """

    def __init__(self) -> None:
        self.pins = pins = Pins()
        self._scripts: dict[int, Script] = {}
        self._logged: set[int] = set()
        """Unknown commands that were logged."""
        self._handlers: dict[str, Callable[[float, int, int, bytes], int]] = {
            "MODES": lambda time, gpio, mode, _: pins.set_mode(time, gpio, mode),
            "MODEG": lambda time, gpio, _, __: pins.mode(gpio),
            "READ": lambda time, gpio, _, __: pins.level(time, gpio),
            "WRITE": lambda time, gpio, level, _: pins.write(time, gpio, level),
            "PWM": lambda time, gpio, duty, _: pins.pwm(time, gpio, duty),
            "SERVO": lambda time, gpio, width, _: pins.servo(time, gpio, width),
            "PIGPV": lambda _, __, ___, ____: VERSION,
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
            "PROCS": lambda time, script, _, __: self._script(script).stop(),
            "PROCU": lambda time, script, _, extension: self._script(script).update(
                _parameters(extension)
            ),
            # Clients read these answers as numbers, never as errors.
            "BR1": lambda time, _, __, ___: pins.levels(time),
            "BR2": lambda _, __, ___, ____: 0,
            "TICK": lambda time, _, __, ___: int(time * 1e6),
            "HWVER": lambda _, __, ___, ____: HARDWARE_REVISION,
            # pigpio.pi() sends these to open and close a handle for notifications.
            "NOIB": lambda _, __, ___, ____: 0,
            "NC": lambda _, __, ___, ____: 0,
        }

    def restart(self, time: float) -> None:
        """Reset as after a restart: without pulses and scripts."""
        self.pins.reset(time)
        self._scripts.clear()

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
