"""Who is told of which GPIO: the notifications, watchdogs and filters of the emulated pigpiod."""

import math
import struct
from collections.abc import Callable, Iterator

from fishd.emulation.pigpiod import errors
from fishd.emulation.pigpiod.errors import PigpioError
from fishd.emulation.pigpiod.pins import USER_GPIOS, Pins

HANDLES = 32
WATCHDOG, EVENT = 1 << 5, 1 << 7
"""Flags of a report that is not about a level."""
_REPORT = struct.Struct("<HHII")
_ROUNDING = 1e-9

Send = Callable[[bytes], None]


class _Handle:
    def __init__(self, send: Send) -> None:
        self.send = send
        self.bits = self.events = self.sequence = 0


class _Filter:
    """Glitch and noise filter of one GPIO; times in seconds."""

    def __init__(self) -> None:
        self.glitch = self.noise = self.active = 0.0
        self.since = self.until = -math.inf

    def change(self, time: float) -> None:
        if self.noise and time >= self.until and time - self.since >= self.noise - _ROUNDING:
            self.until = time + self.active
        self.since = time

    def passes(self, time: float) -> bool:
        steady = time - self.since >= self.glitch - _ROUNDING
        return steady and (not self.noise or time < self.until)


class Monitor:
    """Watches levels and sends reports; times are seconds and must not go back."""

    def __init__(
        self,
        pins: Pins,
        awaited: Callable[[], int],
        changed: Callable[[float, int, int], None],
    ) -> None:
        """`awaited`: gives the GPIOs that scripts wait for, as bits.

        `changed`: told of every change: time, bits of levels, bits of events.
        """
        self._pins = pins
        self._awaited = awaited
        self._changed = changed
        self._handles: dict[int, _Handle] = {}
        self._handle_bits = 0
        self._watchdogs: dict[int, tuple[float, float]] = {}  # time-out, start
        self._filters: dict[int, _Filter] = {}
        self._seen = -math.inf
        self._levels = self._reported = 0

    @property
    def bits(self) -> int:
        """The GPIOs that anybody wants to know of."""
        return self._awaited() | self._handle_bits

    def open(self, send: Send) -> int:
        """A new handle, whose reports go to `send`; NO_HANDLE when all are taken."""
        for number in range(HANDLES):
            if number not in self._handles:
                self._handles[number] = _Handle(send)
                return number
        raise PigpioError(errors.NO_HANDLE)

    def begin(self, time: float, number: int, bits: int) -> int:
        """Report these GPIOs from now on; 0 for none."""
        handle = self._handle(number)
        self.look(time)
        handle.bits = bits
        self._sum_up()
        return 0

    def watch_events(self, number: int, bits: int) -> int:
        """Report these events from now on."""
        self._handle(number).events = bits
        return 0

    def close(self, number: int) -> int:
        """Give a handle back."""
        self._handle(number)
        del self._handles[number]
        self._sum_up()
        return 0

    def close_all(self, send: Send) -> None:
        """Give back the handles of a client that is gone."""
        for number, handle in list(self._handles.items()):
            if handle.send == send:
                self.close(number)

    def trigger_event(self, time: float, event: int) -> int:
        """Report an event, 0–31."""
        if event > 31:
            raise PigpioError(errors.BAD_EVENT_ID)
        for handle in list(self._handles.values()):
            if handle.events >> event & 1:
                self._send(handle, EVENT | event, time)
        self._changed(time, 0, 1 << event)
        return 0

    def set_watchdog(self, time: float, gpio: int, milliseconds: int) -> int:
        """Report each time that a GPIO has not changed for so long; 0 ends it."""
        _check_user(gpio)
        if milliseconds > 60_000:
            raise PigpioError(errors.BAD_WDOG_TIMEOUT)
        self._watchdogs.pop(gpio, None)
        if milliseconds:
            self._watchdogs[gpio] = (milliseconds * 1e-3, time)
        return 0

    def set_glitch_filter(self, gpio: int, steady: int) -> int:
        """Report only levels that lasted so long [µs]; 0 ends it."""
        _check_user(gpio)
        _check_filter(steady, 300_000)
        self._filters.setdefault(gpio, _Filter()).glitch = steady * 1e-6
        return 0

    def set_noise_filter(self, gpio: int, steady: int, active: int) -> int:
        """After a level that lasted `steady` [µs], report changes for `active` [µs]; 0 ends it."""
        _check_user(gpio)
        _check_filter(steady, 300_000)
        _check_filter(active, 1_000_000)
        noise = self._filters.setdefault(gpio, _Filter())
        noise.noise, noise.active, noise.until = steady * 1e-6, active * 1e-6, -math.inf
        return 0

    def next_time(self) -> float:
        """When there will be something to report, as far as is known [s]; infinity: nothing."""
        bits = self.bits
        return min(self._due_times(bits), default=math.inf) if bits else math.inf

    def resume(self, time: float) -> None:
        """Take the levels as they are, without reporting what was missed."""
        self._seen = time
        self._levels = self._reported = self._pins.levels(time, 0)
        self._watchdogs = {gpio: (limit, time) for gpio, (limit, _) in self._watchdogs.items()}

    def look(self, time: float) -> None:
        """Take the levels of now, and report what has changed and what has not for too long."""
        self._seen = time
        levels = self._pins.levels(time, 0)
        changed, self._levels = levels ^ self._levels, levels
        for gpio, its_filter in self._filters.items():
            if changed >> gpio & 1:
                its_filter.change(time)
            if (levels ^ self._reported) >> gpio & 1 and not its_filter.passes(time):
                levels ^= 1 << gpio
        moved, self._reported = levels ^ self._reported, levels
        for handle in list(self._handles.values()) if moved else ():
            if moved & handle.bits:
                self._send(handle, 0, time)
        for gpio, (limit, start) in self._watchdogs.items():
            if moved >> gpio & 1:
                self._watchdogs[gpio] = (limit, time)
            elif time >= start + limit - _ROUNDING:
                self._watchdogs[gpio] = (limit, time)
                for handle in list(self._handles.values()):
                    if handle.bits >> gpio & 1:
                        self._send(handle, WATCHDOG | gpio, time)
        if moved:
            self._changed(time, moved, 0)

    def _sum_up(self) -> None:
        self._handle_bits = 0
        for handle in self._handles.values():
            self._handle_bits |= handle.bits

    def _due_times(self, bits: int) -> Iterator[float]:
        for gpio in range(USER_GPIOS):
            if bits >> gpio & 1:
                yield self._pins.pins[gpio].train.next_edge(self._seen)
                if gpio in self._watchdogs:
                    yield sum(self._watchdogs[gpio])
                if gpio in self._filters and (self._levels ^ self._reported) >> gpio & 1:
                    its_filter = self._filters[gpio]
                    due = its_filter.since + its_filter.glitch
                    yield due if due > self._seen else math.inf

    def _send(self, handle: _Handle, flags: int, time: float) -> None:
        tick = int(time * 1e6) & 0xFFFFFFFF
        handle.send(_REPORT.pack(handle.sequence, flags, tick, self._reported))
        handle.sequence = (handle.sequence + 1) & 0xFFFF

    def _handle(self, number: int) -> _Handle:
        handle = self._handles.get(number)
        if handle is None:
            raise PigpioError(errors.BAD_HANDLE)
        return handle


def _check_user(gpio: int) -> None:
    if gpio >= USER_GPIOS:
        raise PigpioError(errors.BAD_USER_GPIO)


def _check_filter(microseconds: int, most: int) -> None:
    if microseconds > most:
        raise PigpioError(errors.BAD_FILTER)
