"""PCA9685 emulated at the level of its registers, for an `I2cBus`; data sheet: NXP, Rev. 4."""

import errno

from fishd.core.clock import Clock
from fishd.virtual.pi.i2c import kernel_error
from fishd.virtual.pi.pulse_train import PulseTrain

MODE1, MODE2, LED0, PRE_SCALE = 0x00, 0x01, 0x06, 0xFE
RESTART, AUTO_INCREMENT, SLEEP = 0x80, 0x20, 0x10
FULL = 0x10
OSCILLATOR = 25e6
START_UP = 500e-6


class Pca9685Chip:
    """Emulated chip with sixteen channels, of which one is recorded."""

    def __init__(self, clock: Clock, channel: int = 0) -> None:
        self.clock = clock
        self.channel = channel
        self.plugged_in = True
        self.refused: set[tuple[int, int]] = set()
        """Registers and values whose write is not acknowledged."""
        self.pulses = PulseTrain()
        self.writes: list[bytes] = []
        self.reset()

    def reset(self) -> None:
        """Reset as after power-on."""
        self.registers = bytearray(256)
        self.registers[MODE1], self.registers[MODE2] = SLEEP | 0x01, 0x04
        self.registers[PRE_SCALE] = 0x1E
        for channel in range(16):
            self.registers[LED0 + 4 * channel + 3] = FULL
        self._pointer = 0
        self._runs_from = 0.0
        self._update()

    def power_cycle(self) -> None:
        """Simulate a brown-out, which cuts off a running pulse."""
        self.pulses.cut(self.clock.monotonic())
        self.reset()

    def width(self, time: float) -> float:
        """Return the pulse at a time [µs]; 0 without pulses."""
        return self.pulses.width(time)

    def write(self, data: bytes) -> None:
        self._need_power()
        if not data:
            return
        self.writes.append(data)
        self._pointer = data[0]
        for value in data[1:]:
            if (self._pointer, value) in self.refused:
                raise kernel_error(errno.EREMOTEIO)
            self._store(self._pointer, value)
            self._advance()
        self._update()  # at the stop condition, because OCH is 0

    def read(self, length: int) -> bytes:
        self._need_power()
        content = bytearray()
        for _ in range(length):
            content.append(self.registers[self._pointer])
            self._advance()
        return bytes(content)

    def _need_power(self) -> None:
        if not self.plugged_in:
            raise kernel_error(errno.EREMOTEIO)

    def _advance(self) -> None:
        if self.registers[MODE1] & AUTO_INCREMENT:
            self._pointer = 0 if self._pointer == 0x45 else (self._pointer + 1) & 0xFF

    def _store(self, register: int, value: int) -> None:
        mode = self.registers[MODE1]
        if register == PRE_SCALE:
            if mode & SLEEP:  # otherwise the write is blocked
                self.registers[PRE_SCALE] = max(3, value)
        elif register == MODE1:
            self._set_mode(mode, value)
        else:
            self.registers[register] = value

    def _set_mode(self, mode: int, value: int) -> None:
        restart = mode & RESTART
        if not mode & SLEEP and value & SLEEP:
            restart = RESTART if any(map(self._on, range(16))) else 0
        if mode & SLEEP and not value & SLEEP:
            self._runs_from = self.clock.monotonic() + START_UP
        ready = not mode & SLEEP and self.clock.monotonic() >= self._runs_from
        if value & RESTART and ready:
            restart = 0
        self.registers[MODE1] = value & ~RESTART | restart

    def _counts(self, channel: int) -> tuple[int, int]:
        first = LED0 + 4 * channel
        on, off = (self.registers[i] | self.registers[i + 1] << 8 for i in (first, first + 2))
        return on, off

    def _on(self, channel: int) -> bool:
        on, off = self._counts(channel)
        return not off & FULL << 8 and on & 0xFFF != off & 0xFFF

    def _update(self) -> None:
        """Update the recorded pulses of the channel."""
        now = max(self.clock.monotonic(), self._runs_from)
        on, off = self._counts(self.channel)
        asleep = self.registers[MODE1] & (SLEEP | RESTART)
        counts = 0 if asleep or not self._on(self.channel) else (off - on) % 4096
        step = (self.registers[PRE_SCALE] + 1) / OSCILLATOR
        self.pulses.set(now, counts * step * 1e6, 4096 * step)
