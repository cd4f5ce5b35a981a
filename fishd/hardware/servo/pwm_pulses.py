"""Channel of a PWM chip of the kernel, through its files below /sys/class/pwm, and its pulses.

The hardware makes the pulses, so they outlive their process. This module needs only the standard
library.
"""

import errno
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

from fishd.core.errors import ServoError
from fishd.hardware.servo.pulses import NEUTRAL_TIME_S

_BROADCOM = {12: 0, 18: 0, 13: 1, 19: 1}

HEADER_CHIPS: dict[str, dict[int, int]] = {
    # Pi 5. Channels 0 and 1 are from the list of `pinctrl funcs`, not tested on hardware.
    "1f00098000.pwm": {18: 2, 19: 3, 12: 0, 13: 1},
    # Pi 4. Not tested, like the two below: from the chip's address in the device tree.
    "fe20c000.pwm": _BROADCOM,
    "3f20c000.pwm": _BROADCOM,  # Pi 2, 3, Zero 2
    "2020c000.pwm": _BROADCOM,  # Pi 1, Zero
}
"""Channels of the pins of the 40-pin header, by the device name of the chip.

Device names are stable; the N of pwmchipN changes from kernel to kernel.
"""
UDEV_TIMEOUT_S = 2.0
"""Longest wait for udev to make a new channel's files writable [s]; ticks do not wait for it."""
READ_BACK_S = 0.1
"""Time within which another program that drives the channel writes again [s]."""


class Wires(NamedTuple):
    """Pin and PWM channel that a servo is wired to."""

    gpio: int
    root: str
    """Folder of the PWM chips."""
    chip: str | None
    """Device of the chip; None for the chip of the Pi's header."""
    channel: int | None
    """Channel of the chip; None for the channel that the pin is wired to."""


class PwmChannel:
    """One channel; each method raises `ServoError` with one line that gives the remedy."""

    NAMES = ("period", "duty_cycle", "enable")
    """Names of the files with a number: two times [ns], and 1 for on."""

    def __init__(self, servo: Wires, clock: Any, files: Any = os) -> None:
        """Store the arguments; `open` finds the channel.

        clock: one of fishd's, or module `time`
        files: module `os`, or an emulated kernel with its functions
        """
        self._servo = servo
        self._files = files
        self._clock = clock
        self._fds: dict[str, int] = {}
        self._chip = ""
        self._number = 0
        self.path = ""
        """Folder of the channel; empty before the first `open`."""
        self.exported = False
        """Whether this object has exported the channel."""

    def open(self, timeout: float) -> None:
        """Find the channel, export it if necessary, and open its files if they are not open.

        timeout: longest wait for udev to make the files of a new channel writable [s]
        """
        if self._fds:
            return
        self._chip, device = self._find_chip()
        self._number = _channel_number(self._servo, device)
        self.path = f"{self._chip}/pwm{self._number}"
        if not self._is_exported():
            self._export()
        deadline = self._clock.monotonic() + timeout
        while True:
            try:
                for name in self.NAMES:
                    self._fds[name] = self._files.open(f"{self.path}/{name}", os.O_RDWR)
                return
            except OSError as error:
                self.close()
                late = self._clock.monotonic() >= deadline
                if late or not isinstance(error, PermissionError | FileNotFoundError):
                    raise _explain(f"{self.path}/{name}", error) from None
            self._clock.sleep(0.01)

    @contextmanager
    def borrow(self) -> Iterator[None]:
        """Open the channel within the context; unexport it at the end if that has exported it."""
        try:
            self.open(UDEV_TIMEOUT_S)
            yield
        finally:
            self.close()
            if self.exported:
                self.unexport()

    def read(self, name: str) -> int:
        """Return the number in a file of the open channel."""
        try:
            # A plain file, as in tests, keeps the tail of an earlier, longer text.
            return int(self._files.pread(self._fds[name], 32, 0).split()[0])
        except OSError as error:
            raise _explain(f"{self.path}/{name}", error) from None
        except (ValueError, IndexError):
            raise ServoError(f"{self.path}/{name} does not contain a number") from None

    def write(self, name: str, value: int) -> None:
        """Write a number to a file of the open channel."""
        try:
            self._files.pwrite(self._fds[name], b"%d\n" % value, 0)
        except OSError as error:
            raise _explain(f"{self.path}/{name}", error) from None

    def inverted(self) -> bool:
        """Return whether the polarity is inverted, as another program may have left it."""
        return self._polarity() == b"inversed"

    def start_pulses(self, width: float, period: float) -> None:
        """Start pulses [µs], one in each period [s], from any state of the channel.

        An unused channel has a period of 0, and older kernels then refuse a duty cycle, even 0, and
        a polarity. A kernel that has recorded a channel as on ignores enable 1, even if the
        hardware is off because the channel was unexported: so the channel is switched off first.
        """
        if self.read("enable"):
            self.write("enable", 0)
        if self.read("duty_cycle"):
            self.write("duty_cycle", 0)
        self.write("period", round(1e9 * period))
        if self.inverted():
            self._polarity(b"normal\n")
        self.change_pulses(width)
        self.write("enable", 1)

    def change_pulses(self, width: float) -> None:
        """Change the width of the pulses [µs] from the next one on; 0 ends them."""
        self.write("duty_cycle", round(1000.0 * width))

    def has_pulses(self) -> bool:
        """Return whether there are pulses."""
        return bool(self.read("enable") and self.read("duty_cycle"))

    def switch_off(self, period: float) -> None:
        """Switch the channel off, once the last pulse before a duty cycle of 0 has ended."""
        with suppress(ServoError):  # a channel that cannot be read may be on
            if not self.read("enable"):
                return
        self._clock.sleep(period)
        self.write("enable", 0)

    def _polarity(self, wanted: bytes = b"") -> bytes:
        """Set the polarity if one is wanted; return it. A chip without polarity is normal."""
        path = f"{self.path}/polarity"
        try:
            fd = self._files.open(path, os.O_RDWR)
            try:
                if wanted:
                    self._files.pwrite(fd, wanted, 0)
                polarity: bytes = self._files.pread(fd, 32, 0).strip()
                return polarity
            finally:
                self._files.close(fd)
        except FileNotFoundError:
            return b"normal"
        except OSError as error:
            raise _explain(path, error) from None

    def close(self) -> None:
        """Close the files without changing the channel."""
        while self._fds:
            with suppress(OSError):  # Linux closes it nevertheless
                self._files.close(self._fds.popitem()[1])

    def unexport(self) -> None:
        """Unexport the channel if it is exported."""
        if self.path and self._is_exported():
            self._write_chip("unexport")
        self.exported = False

    def _find_chip(self) -> tuple[str, str]:
        """Return the chip's folder and its device."""
        servo, root = self._servo, self._servo.root
        wanted = [servo.chip] if servo.chip else list(HEADER_CHIPS)
        chips = {}
        try:
            for name in self._files.listdir(root):
                if name.startswith("pwmchip"):
                    device = self._files.readlink(f"{root}/{name}/device")
                    chips[os.path.basename(device)] = f"{root}/{name}"  # noqa: PTH119
        except OSError as error:
            raise ServoError(f"no PWM chips can be found in {root}: {error.strerror}") from None
        for device in wanted:
            if device in chips:
                return chips[device], device
        overlay = "pwm-2chan"
        if servo.gpio in (12, 13):
            overlay += ",pin=12,func=4,pin2=13,func2=4"
        raise ServoError(
            f"no PWM chip {' or '.join(wanted)} in {root}, which has "
            f"{', '.join(sorted(chips)) or 'none'}: add dtoverlay={overlay} to "
            "/boot/firmware/config.txt and reboot, or name the chip in servo.chip"
        )

    def _is_exported(self) -> bool:
        try:
            return f"pwm{self._number}" in self._files.listdir(self._chip)
        except OSError as error:
            raise _explain(self._chip, error) from None

    def _export(self) -> None:
        try:
            self._write_chip("export")
        except ServoError:
            # Another program may have exported it first.
            if not self._is_exported():
                raise
        else:
            self.exported = True

    def _write_chip(self, name: str) -> None:
        path = f"{self._chip}/{name}"
        try:
            fd = self._files.open(path, os.O_WRONLY)
            try:
                self._files.pwrite(fd, b"%d\n" % self._number, 0)
            finally:
                self._files.close(fd)
        except OSError as error:
            if error.errno in (errno.ENODEV, errno.EINVAL) and name == "export":
                raise ServoError(
                    f"servo.channel: {self._chip} has no channel {self._number}"
                ) from None
            if error.errno == errno.EBUSY:
                raise ServoError(
                    f"channel {self._number} of {self._chip} is in use by a driver of the kernel: "
                    "choose another pin with servo.gpio, or channel with servo.channel"
                ) from None
            raise _explain(path, error) from None


def _channel_number(servo: Wires, device: str) -> int:
    if servo.channel is not None:
        return servo.channel
    if device not in HEADER_CHIPS:
        raise ServoError(
            f"servo.channel is missing: for chip {device} it is not known which channel "
            f"drives GPIO {servo.gpio}"
        )
    channels = HEADER_CHIPS[device]
    if servo.gpio not in channels:
        raise ServoError(
            f"servo.gpio: GPIO {servo.gpio} has no hardware PWM; "
            f"{', '.join(map(str, sorted(channels)))} have"
        )
    return channels[servo.gpio]


def _explain(path: str, error: OSError) -> ServoError:
    """Return an error with one line about an error of the file system."""
    hint = f"cannot be used: {error.strerror}"
    if isinstance(error, PermissionError):
        hint = (
            "may not be used by this user: join group gpio, and let fishd's udev rule "
            "give it the files of PWM chips (in its Debian package)"
        )
    elif error.errno in (errno.ENOENT, errno.ENODEV):
        hint = "is gone: was the PWM chip's driver unloaded, or the channel unexported?"
    return ServoError(f"{path} {hint}")


def neutralise(
    neutral: float, *, frequency: float, files: Any = os, clock: Any = time, **wires: Any
) -> bool:
    """Send neutral [µs] for 0.3 s and end the pulses; return False if there are none.

    For the case that fishd is dead; the next write of a fishd that is alive fails, because its
    pulses are off. If a step fails, it still tries to stop the pulses, and raises `ServoError`.

    wires: fields of `Wires`
    """
    channel, period = PwmChannel(Wires(**wires), clock, files), 1.0 / frequency
    with channel.borrow():
        if not channel.has_pulses():
            return False
        try:
            if channel.inverted():  # a duty cycle would be the gap between two pulses
                channel.start_pulses(neutral, period)
            else:
                channel.change_pulses(neutral)
            clock.sleep(NEUTRAL_TIME_S)
        finally:
            try:
                channel.change_pulses(0.0)
            finally:
                channel.switch_off(period)
        clock.sleep(READ_BACK_S)
        if channel.has_pulses():
            raise ServoError(f"{channel.path}: has pulses again: another program drives it")
        return True
