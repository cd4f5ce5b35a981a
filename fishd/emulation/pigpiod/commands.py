"""What pigpiod does with a command, whether a client or a script gave it; without any sockets.

Left out are the parts that have nothing to do with GPIO levels and pulses: waves, I2C, SPI, serial
lines, files, clocks and the shell. Such commands are answered with −88, unknown command.
"""

import math
import struct
from collections.abc import Callable

from fishd.emulation.pigpiod import errors
from fishd.emulation.pigpiod.errors import PigpioError
from fishd.emulation.pigpiod.monitor import Monitor, Send
from fishd.emulation.pigpiod.parser import PARAMETERS, parse
from fishd.emulation.pigpiod.pins import Pins
from fishd.emulation.pigpiod.script import Script

VERSION = 79
"""The library's last release, which Raspberry Pi OS ships and whose Python module is 1.78."""
HARDWARE_REVISION = 0xC03112
"""A Raspberry Pi 4B with 4 GB."""
SCRIPTS = 32
MISSED = 1.0
"""Changes of levels longer ago than this are not reported any more [s]."""
PROC, PROCP, MICS, MILS, OPEN_IN_BAND = 38, 45, 46, 47, 99
_STATUS = struct.Struct(f"<{PARAMETERS + 1}i")

_Handler = Callable[[float, int, int, bytes], int]


class Commands:
    """GPIOs, scripts and notifications of one pigpiod; not safe to use from several threads.

    Times are seconds of its clock and must not go back from call to call.
    """

    def __init__(self, step: int) -> None:
        """`step`: what pulses are rounded down to [µs], as with `pigpiod -s`."""
        self.pins = Pins(step)
        self._handlers: dict[int, _Handler] = self._gpio() | self._notification() | self._script()
        self._start()

    def _start(self) -> None:
        self._scripts: dict[int, Script] = {}
        self._monitor = Monitor(self.pins, self._awaited, self._wake)

    def restart(self, time: float) -> None:
        """Die and come back: no pulses, no scripts, no handles."""
        self.pins.reset(time)
        self._start()

    def resume(self, time: float) -> None:
        """Go on at a time [s] after having stood still."""
        for script in self._scripts.values():
            script.hold(time)
        self._monitor.resume(time)

    def advance(self, time: float) -> None:
        """Let everything happen that is due up to a time [s]."""
        while True:
            report = self._monitor.next_time()
            due = following = math.inf
            for number, script in self._scripts.items():
                if script.time < due:
                    due, following, earliest = script.time, due, number
                elif script.time < following:
                    following = script.time
            if due > time and report > time:
                return
            if report < time - MISSED:
                self._monitor.resume(time - MISSED)
            elif report <= due:
                self._monitor.look(report)
            else:
                # While levels are watched every instruction may change what is due next.
                watched = bool(self._monitor.bits)
                script = self._scripts[earliest]
                script.run(due if watched else min(time, following))
                if script.waits_for and not watched:
                    self._monitor.resume(script.waits_since)

    def next_time(self) -> float:
        """When somebody who watches will have to be told something [s]; infinity: nobody."""
        if not self._monitor.bits:
            return math.inf
        scripts = min((script.time for script in self._scripts.values()), default=math.inf)
        return min(self._monitor.next_time(), scripts)

    def execute(
        self, time: float, number: int, p1: int, p2: int, extension: bytes
    ) -> tuple[int, bytes]:
        """Carry out a command at a time [s] up to which everything has happened.

        Gives the result, negative for an error, and the bytes that follow it.
        """
        if number == PROCP:
            script = self._scripts.get(p1)
            if script is None:
                return errors.BAD_SCRIPT_ID, b""
            return _STATUS.size, _STATUS.pack(script.state(time), *script.parameters)
        return self._execute(time, number, p1, p2, extension), b""

    def open_handle(self, send: Send) -> int:
        """A notification handle whose reports go to `send`, or a negative error."""
        try:
            return self._monitor.open(send)
        except PigpioError as error:
            return error.number

    def close_handles(self, send: Send) -> None:
        """Forget a client that is gone."""
        self._monitor.close_all(send)

    @staticmethod
    def delay(number: int, amount: int) -> tuple[int, float]:
        """The result of MICS or MILS and the time until it is to be sent [s]."""
        if number == MICS:
            return (0, amount * 1e-6) if amount <= 1_000_000 else (errors.BAD_MICS_DELAY, 0.0)
        return (0, amount * 1e-3) if amount <= 60_000 else (errors.BAD_MILS_DELAY, 0.0)

    def _execute(self, time: float, number: int, p1: int, p2: int, extension: bytes) -> int:
        handler = self._handlers.get(number)
        if handler is None:
            return errors.UNKNOWN_COMMAND
        try:
            return handler(time, p1, p2, extension)
        except PigpioError as error:
            return error.number
        finally:
            if self._monitor.bits:
                self._monitor.look(time)

    def _gpio(self) -> dict[int, _Handler]:
        pins = self.pins
        return {
            0: lambda time, gpio, mode, _: pins.set_mode(time, gpio, mode),
            1: lambda time, gpio, _, __: pins.get_mode(gpio),
            2: lambda time, gpio, pull, _: pins.set_pull(gpio, pull),
            3: lambda time, gpio, _, __: pins.level(time, gpio),
            4: lambda time, gpio, level, _: pins.write(time, gpio, level),
            5: lambda time, gpio, duty, _: pins.pwm(time, gpio, duty),
            6: lambda time, gpio, duty_range, _: pins.set_range(time, gpio, duty_range),
            7: lambda time, gpio, frequency, _: pins.set_frequency(time, gpio, frequency),
            8: lambda time, gpio, width, _: pins.servo(time, gpio, width),
            10: lambda time, _, __, ___: pins.levels(time, 0),
            11: lambda time, _, __, ___: pins.levels(time, 1),
            12: lambda time, bits, _, __: pins.write_bank(0, bits, 0),
            13: lambda time, bits, _, __: pins.write_bank(1, bits, 0),
            14: lambda time, bits, _, __: pins.write_bank(0, bits, 1),
            15: lambda time, bits, _, __: pins.write_bank(1, bits, 1),
            16: lambda time, _, __, ___: int(time * 1e6),
            17: lambda time, _, __, ___: HARDWARE_REVISION,
            22: lambda time, gpio, _, __: pins.get_range(gpio),
            23: lambda time, gpio, _, __: pins.frequency(gpio),
            24: lambda time, gpio, _, __: pins.real_range(gpio),
            25: lambda time, _, __, ___: 0,
            26: lambda time, _, __, ___: VERSION,
            37: self._trigger,
            83: lambda time, gpio, _, __: pins.duty(gpio),
            84: lambda time, gpio, _, __: pins.servo_width(gpio),
            86: lambda time, gpio, frequency, extension: pins.hardware_pwm(
                time, gpio, frequency, _number(extension)
            ),
        }

    def _notification(self) -> dict[int, _Handler]:
        return {
            9: lambda time, gpio, limit, _: self._monitor.set_watchdog(time, gpio, limit),
            19: lambda time, handle, bits, _: self._monitor.begin(time, handle, bits),
            20: lambda time, handle, _, __: self._monitor.begin(time, handle, 0),
            21: lambda time, handle, _, __: self._monitor.close(handle),
            97: lambda time, gpio, steady, _: self._monitor.set_glitch_filter(gpio, steady),
            98: lambda time, gpio, steady, extension: self._monitor.set_noise_filter(
                gpio, steady, _number(extension)
            ),
            115: lambda time, handle, bits, _: self._monitor.watch_events(handle, bits),
            116: lambda time, event, _, __: self._monitor.trigger_event(time, event),
        }

    def _script(self) -> dict[int, _Handler]:
        return {
            38: lambda time, _, __, text: self._store(time, text),
            39: lambda time, number, _, __: self._delete(number),
            40: lambda time, number, _, extension: self._known(number).start(
                time, _parameters(extension)
            ),
            41: lambda time, number, _, __: self._known(number).stop(time),
            117: lambda time, number, _, extension: self._known(number).update(
                _parameters(extension)
            ),
        }

    def _trigger(self, time: float, gpio: int, length: int, extension: bytes) -> int:
        level = _number(extension)
        self.pins.trigger(gpio, length, level)
        if self._monitor.bits:
            self._monitor.look(time)
        self.pins.pins[gpio].latch = 1 - level
        if self._monitor.bits:
            self._monitor.look(time + length * 1e-6)
        return 0

    def _store(self, time: float, text: bytes) -> int:
        program = parse(text.partition(b"\0")[0].decode("latin-1"))
        for number in range(SCRIPTS):
            if number not in self._scripts:
                self._scripts[number] = Script(program, self._execute, time)
                return number
        raise PigpioError(errors.NO_SCRIPT_ROOM)

    def _delete(self, number: int) -> int:
        self._known(number)
        del self._scripts[number]
        return 0

    def _known(self, number: int) -> Script:
        script = self._scripts.get(number)
        if script is None:
            raise PigpioError(errors.BAD_SCRIPT_ID)
        return script

    def _wake(self, time: float, levels: int, events: int) -> None:
        for script in self._scripts.values():
            if script.waits_for & levels or script.waits_for_events & events:
                script.wake(time, (script.waits_for & levels) | (script.waits_for_events & events))

    def _awaited(self) -> int:
        bits = 0
        for script in self._scripts.values():
            bits |= script.waits_for
        return bits


def _number(extension: bytes) -> int:
    return int.from_bytes(extension[:4], "little")


def _parameters(extension: bytes) -> tuple[int, ...]:
    count = len(extension) // 4
    if count > PARAMETERS:
        raise PigpioError(errors.TOO_MANY_PARAM)
    return struct.unpack(f"<{count}i", extension[: 4 * count])
