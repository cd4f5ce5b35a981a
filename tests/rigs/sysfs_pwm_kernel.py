"""PWM class of the kernel as files in memory, with the checks and errors of Linux.

It replaces module `os` in `fishd.hardware.servo.pwm_pulses`. It is as strict as kernels up to 6.9,
which refuse everything while the period is 0, and ignore a state that they believe to be set.
"""

import errno
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from fishd.core.clock import Clock
from fishd.hardware.servo.pwm_pulses import PwmChannel
from fishd.virtual.pi.pulse_train import PulseTrain


@dataclass(frozen=True)
class _State:
    """State of a channel in the kernel; times in ns."""

    period: int = 0
    duty_cycle: int = 0
    enable: int = 0
    polarity: str = "normal"


@dataclass
class _Channel:
    state: _State = _State()
    exported_at: float | None = None
    pulses: PulseTrain = field(default_factory=PulseTrain)
    """Output of the hardware."""


class SysfsPwm:
    """PWM chips below `root`, and the functions of module `os` to use them with."""

    def __init__(
        self,
        clock: Clock,
        chips: Mapping[str, int],
        root: str = "/sys/class/pwm",
        udev_delay: float = 0.03,
    ) -> None:
        """`chips`: number of channels of each device, in the order of the chips' numbers.

        udev_delay: time after an export in which the files of a channel belong to root only [s]
        """
        self._clock = clock
        self._root = root
        self._udev_delay = udev_delay
        self.unwritable: set[tuple[str, int]] = set()
        """Names of files and values whose write fails."""
        self.unreadable: set[str] = set()
        """Names of files whose read fails."""
        self._chips = {device: [_Channel() for _ in range(n)] for device, n in chips.items()}
        self._numbers = dict(enumerate(chips))
        self._taken: set[tuple[str, int]] = set()
        self._fds: dict[int, tuple[str, int | None, str]] = {}
        self._next_fd = 1000  # distinct from real descriptors

    def pulses(self, device: str, channel: int) -> PulseTrain:
        """Return the output of a channel."""
        return self._chips[device][channel].pulses

    def take(self, device: str, channel: int) -> None:
        """Let a driver of the kernel use a channel, like that of the Pi 5's fan."""
        self._taken.add((device, channel))

    def unload(self, device: str) -> None:
        """Unload a chip's driver, which removes its pulses and files, also open ones."""
        for number, channel in enumerate(self._chips[device]):
            if channel.exported_at is not None:
                self._unexport(device, number)
            channel.state = _State()
        self._numbers = {n: chip for n, chip in self._numbers.items() if chip != device}

    def load(self, device: str, number: int) -> None:
        """Load a chip's driver again, which gets the next free number."""
        self._numbers[number] = device

    def open(self, path: str, flags: int, /) -> int:
        """Replace os.open."""
        device, channel, name = self._find(path)
        if channel is not None:
            since = self._chips[device][channel].exported_at or 0.0
            writing = flags & (os.O_WRONLY | os.O_RDWR)
            if writing and self._clock.monotonic() < since + self._udev_delay:
                raise _error(errno.EACCES, path)
        self._next_fd += 1
        self._fds[self._next_fd] = (device, channel, name)
        return self._next_fd

    def close(self, fd: int, /) -> None:
        """Replace os.close."""
        if self._fds.pop(fd, None) is None:
            raise _error(errno.EBADF)

    def pread(self, fd: int, length: int, offset: int, /) -> bytes:
        """Replace os.pread."""
        device, channel, name = self._opened(fd)
        if channel is None:
            raise _error(errno.EIO)  # export and unexport are write-only
        if name in self.unreadable:
            raise _error(errno.EIO)
        text = f"{getattr(self._chips[device][channel].state, name)}\n".encode()
        return text[offset : offset + length]

    def pwrite(self, fd: int, data: bytes, offset: int, /) -> int:
        """Replace os.pwrite."""
        device, channel, name = self._opened(fd)
        if name == "polarity" and channel is not None:
            self._apply(self._chips[device][channel], name, data.decode().strip())
            return len(data)
        try:
            value = int(data)
        except ValueError:
            raise _error(errno.EINVAL) from None
        if (name, value) in self.unwritable:
            raise _error(errno.EIO)
        if channel is not None:
            self._apply(self._chips[device][channel], name, value)
        elif not 0 <= value < len(self._chips[device]):
            raise _error(errno.ENODEV)
        elif name == "export":
            self._export(device, value)
        else:
            self._unexport(device, value)
        return len(data)

    def listdir(self, path: str, /) -> list[str]:
        """Replace os.listdir."""
        folders = {self._root: [f"pwmchip{number}" for number in self._numbers]}
        for number, device in self._numbers.items():
            channels = enumerate(self._chips[device])
            exported = [f"pwm{n}" for n, channel in channels if channel.exported_at is not None]
            folders[f"{self._root}/pwmchip{number}"] = ["device", "export", "unexport", *exported]
        if path not in folders:
            raise _error(errno.ENOENT, path)
        return folders[path]

    def readlink(self, path: str, /) -> str:
        """Replace os.readlink."""
        folder, _, name = path.rpartition("/")
        if name != "device" or name not in self.listdir(folder):
            raise _error(errno.ENOENT, path)
        return f"../../../{self._device(folder)}"

    def _find(self, path: str) -> tuple[str, int | None, str]:
        """Return device, channel and name of a file; no channel for export and unexport."""
        folder, _, name = path.rpartition("/")
        if name in ("export", "unexport") and name in self.listdir(folder):
            return self._device(folder), None, name
        chip, _, channel = folder.rpartition("/")
        if name not in (*PwmChannel.NAMES, "polarity") or channel not in self.listdir(chip):
            raise _error(errno.ENOENT, path)
        return self._device(chip), int(channel.removeprefix("pwm")), name

    def _device(self, folder: str) -> str:
        return self._numbers[int(folder.removeprefix(f"{self._root}/pwmchip"))]

    def _opened(self, fd: int) -> tuple[str, int | None, str]:
        """Return the device, channel and name of the open file `fd`."""
        if fd not in self._fds:
            raise _error(errno.EBADF)
        device, channel, name = self._fds[fd]
        gone = device not in self._numbers.values()
        if gone or (channel is not None and self._chips[device][channel].exported_at is None):
            raise _error(errno.ENODEV)
        return device, channel, name

    def _export(self, device: str, number: int) -> None:
        channel = self._chips[device][number]
        if channel.exported_at is not None or (device, number) in self._taken:
            raise _error(errno.EBUSY)
        channel.exported_at = self._clock.monotonic()

    def _unexport(self, device: str, number: int) -> None:
        """Unexport a channel: the driver switches the hardware off; the kernel's state remains."""
        channel = self._chips[device][number]
        if channel.exported_at is None:
            raise _error(errno.ENODEV)
        channel.exported_at = None
        # An open file remains invalid, even if the channel is exported again.
        dead = [fd for fd, opened in self._fds.items() if opened[:2] == (device, number)]
        for fd in dead:
            self._fds[fd] = ("", None, "")
        channel.pulses.cut(self._clock.monotonic())

    def _apply(self, channel: _Channel, name: str, value: int | str) -> None:
        if name == "enable" and value not in (0, 1):
            raise _error(errno.EINVAL)
        if name == "polarity" and value not in ("normal", "inversed"):
            raise _error(errno.EINVAL)
        state = replace(channel.state, **{name: value})  # type: ignore[arg-type]
        if state.period <= 0 or not 0 <= state.duty_cycle <= state.period:
            raise _error(errno.EINVAL)
        if state == channel.state:
            return
        if name == "polarity" and state.enable:
            raise _error(errno.EBUSY)
        channel.state = state
        now = self._clock.monotonic()
        if state.enable:  # from the next period on
            normal = state.polarity == "normal"
            high = state.duty_cycle if normal else state.period - state.duty_cycle
            channel.pulses.set(now, 1e-3 * high, 1e-9 * state.period)
        else:  # at once
            channel.pulses.cut(now)


def _error(number: int, path: str | None = None) -> OSError:
    return OSError(number, os.strerror(number), path)
