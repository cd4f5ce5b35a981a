"""I2C bus for a driver: opening it, explaining its errors, and the checks of `fishctl doctor`.

Each device has its own open file; the kernel keeps the transfers of several files apart.
"""

import errno
import logging
import os
import re
import stat
from contextlib import suppress
from typing import Annotated, Any

from msgspec import Meta

from fishd.hardware.checks import (
    Check,
    Machine,
    Result,
    fail,
    ok,
    on_this_machine,
    skipped,
    user_name,
    warning,
)
from fishd.hardware.driver import Claim

log = logging.getLogger(__name__)

Bus = Annotated[int, Meta(ge=0, le=255)]
"""Number N of the bus /dev/i2c-N."""

FAST_BIT_RATE = 400_000
"""Recommended bit rate of the bus [bit/s]."""
_HEADER_BUS, _HEADER_PINS = 1, (2, 3)
_SET_TIMEOUT = 0x0702
"""Number of the ioctl I2C_TIMEOUT."""
_TIMEOUT_10MS = 2
"""Timeout of a transfer [10 ms]; the kernel's default is 1 s."""
_ADAPTERS = ("/sys/bus/i2c/devices", "/sys/class/i2c-adapter")
"""Folders in which the kernel lists its buses; the second only before Linux 6.12."""
_CORE_CLOCK = re.compile(r"Raspberry Pi (3|4|Compute Module [34])")
"""Models of Pi whose bus slows down with the core clock."""

_ADVICE = {
    errno.ENOENT: "{bus} does not exist: enable I2C (dtparam=i2c_arm=on in the Pi's config.txt), "
    "or correct {section}.bus",
    errno.EACCES: "{bus} may not be opened: the user of fishd must be in its group, i2c",
    errno.ENODEV: "{bus} has vanished: its adapter was pulled out, or its kernel driver removed",
    errno.EREMOTEIO: "nothing answers at {address} on {bus}: check power and wires of the "
    "{chip}, and {section}.address",
    errno.EIO: "a transfer on {bus} broke off: check wires and pull-ups, or make the bus slower",
    errno.EBUSY: "a kernel driver owns {address} on {bus}: remove its dtoverlay from the Pi's "
    "config.txt",
    errno.ETIMEDOUT: "{bus} hangs: check SDA and SCL for a short, and the power of the {chip}",
    errno.EAGAIN: "something else drives {bus}: check SDA and SCL; fishd must be the only master",
}
_ADVICE[errno.ENXIO] = _ADVICE[errno.EREMOTEIO]


def claim(bus: int) -> Claim:
    """Return the claim of a bus, with the key `bus`; the drivers of one fishd may share a bus."""
    return Claim(f"i2c-{bus}", f"/dev/i2c-{bus}", "bus", _HEADER_PINS if bus == _HEADER_BUS else ())


def open_bus(number: int) -> Any:
    """Open /dev/i2c-`number` with a timeout of 20 ms for a transfer; return it as busio.I2C does.

    Raises OSError, and ImportError if adafruit-extended-bus is missing.
    """
    from adafruit_extended_bus import ExtendedI2C
    from Adafruit_PureIO import smbus

    try:
        bus = ExtendedI2C(number, frequency=None)
    except (ValueError, RuntimeError):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)) from None
    driver = bus._i2c._i2c_bus
    smbus.ioctl(driver._device.fileno(), _SET_TIMEOUT, _TIMEOUT_10MS)
    driver._device = _StrictFile(driver._device)
    return bus


def close_bus(bus: Any) -> None:
    """Close a bus now; the library leaves that to the garbage collector. Never raises OSError."""
    driver = bus._i2c._i2c_bus
    try:
        driver.close()
    except OSError as error:  # Linux has closed it nevertheless
        log.warning("closing an I2C bus failed: %s", error)
        driver._device = None  # otherwise it would be closed again
    bus.deinit()


class _StrictFile:
    """Device file on which a lost transfer is an error.

    A raw file of Python returns None for EAGAIN, which the driver would treat as success.
    """

    def __init__(self, file: Any) -> None:
        self._file = file
        self.fileno = file.fileno
        self.close = file.close

    def read(self, length: int) -> bytes:
        content: bytes | None = self._file.read(length)
        if content is None:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return content

    def write(self, data: bytes) -> None:
        if self._file.write(data) is None:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))


def explain(error: Exception, bus: int, address: int, chip: str, section: str) -> str:
    """Return one line that explains an error of a chip at `address` on /dev/i2c-`bus`.

    The text of an error that differs from Linux's text, such as one of a virtual Pi, is kept.
    section: section with the keys `bus` and `address`, such as `force_sensor`
    """
    if not isinstance(error, OSError):
        return f"{type(error).__name__}: {error}"
    if error.errno is None:
        return str(error)
    if error.strerror != os.strerror(error.errno):
        return f"{error.strerror} (error {error.errno})"
    advice = _ADVICE.get(error.errno, f"a transfer on {{bus}} failed: {error.strerror}")
    names = {"bus": f"/dev/i2c-{bus}", "address": f"{address:#04x}"}
    return f"{advice.format(**names, chip=chip, section=section)} (error {error.errno})"


def checks(bus: int, section: str) -> tuple[Check, ...]:
    """Return the checks of the bus that `section`.bus names."""
    return (
        Check("i2c bus", lambda machine: _bus(machine, bus, section), on_this_machine),
        Check("i2c speed", lambda machine: _speed(machine, bus), on_this_machine),
    )


def _bus(machine: Machine, number: int, section: str) -> Result:
    """Check that the device file exists and that this user may use it."""
    device = machine.path(f"/dev/i2c-{number}")
    if not device.exists():
        buses = sorted(path.name for path in machine.path("/dev").glob("i2c-*"))
        hint = f"; there is {', '.join(buses)}: set {section}.bus" if buses else ""
        return fail(
            f"/dev/i2c-{number} does not exist{hint}",
            "dtparam=i2c_arm=on in /boot/firmware/config.txt, module i2c-dev loaded; restart",
        )
    if not os.access(device, os.R_OK | os.W_OK):
        status = device.stat()
        if status.st_gid == 0 or not status.st_mode & stat.S_IWGRP:
            return fail(
                f"/dev/i2c-{number} may be used by user {user_name(status.st_uid)} only",
                "install the Debian package of fishd, then restart: it gives the bus to group i2c",
            )
        group = device.group()
        return fail(
            f"/dev/i2c-{number} may be used by group {group} only",
            f"sudo usermod -aG {group} $USER, then log in again; the systemd service is in it",
        )
    return ok(f"/dev/i2c-{number} is there and may be used")


def _speed(machine: Machine, number: int) -> Result:
    """Check the speed of the bus that the device tree states."""
    bit_rate = read_bit_rate(machine, number)
    if bit_rate is None:
        return skipped("the kernel does not state the speed of this bus")
    if bit_rate < FAST_BIT_RATE:
        return warning(
            f"{bit_rate / 1e3:.0f} kbit/s: fewer samples per tick than at "
            f"{FAST_BIT_RATE / 1e3:.0f}",
            f"dtparam=i2c_arm_baudrate={FAST_BIT_RATE} in /boot/firmware/config.txt, then restart",
        )
    if _CORE_CLOCK.search(machine.model):
        return ok(
            f"{bit_rate / 1e3:.0f} kbit/s are set; less while this Pi's core clock is lowered, see "
            "docs/how-to/wiring.md"
        )
    return ok(f"{bit_rate / 1e3:.0f} kbit/s")


def read_bit_rate(machine: Machine, number: int) -> int | None:
    """Return the bit rate of the bus in the device tree [bit/s]; None if it is not there."""
    for folder in _ADAPTERS:
        path = machine.path(f"{folder}/i2c-{number}/of_node/clock-frequency")
        with suppress(OSError):
            return int.from_bytes(path.read_bytes(), "big")
    return None
