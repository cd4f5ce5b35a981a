"""An I2C bus for a driver: opening it, explaining its errors, and the checks of `fishctl doctor`.

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

from fishd.hardware.checks import Check, Machine, Result, fail, name_of, ok, skipped, warning
from fishd.hardware.driver import Claim

log = logging.getLogger(__name__)

Bus = Annotated[int, Meta(ge=0, le=255)]
"""N of /dev/i2c-N."""

FAST_BUS = 400_000
"""[bit/s]"""
_HEADER_BUS, _HEADER_PINS = 1, (2, 3)
_I2C_TIMEOUT = 0x0702
_TIMEOUT = 2  # [10 ms]; the kernel's own is 1 s
_ADAPTERS = ("/sys/bus/i2c/devices", "/sys/class/i2c-adapter")
"""Folders in which the kernel lists its buses; the second only before Linux 6.12."""
_CORE_CLOCK = re.compile(r"Raspberry Pi (3|4|Compute Module [34])")
"""Pis whose bus slows down with the core clock."""

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
    """A bus, whose key is `bus`; on it, drivers of one fishd do not disturb each other."""
    return Claim(f"i2c-{bus}", f"/dev/i2c-{bus}", "bus", _HEADER_PINS if bus == _HEADER_BUS else ())


def open_bus(number: int) -> Any:
    """Open /dev/i2c-`number`, on which a transfer may take 20 ms at most; as module busio's I2C.

    Raises OSError, and ImportError where adafruit-extended-bus is missing.
    """
    from adafruit_extended_bus import ExtendedI2C
    from Adafruit_PureIO import smbus

    try:
        bus = ExtendedI2C(number, frequency=None)
    except (ValueError, RuntimeError):
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)) from None
    driver = bus._i2c._i2c_bus
    smbus.ioctl(driver._device.fileno(), _I2C_TIMEOUT, _TIMEOUT)
    driver._device = _StrictFile(driver._device)
    return bus


def close_bus(bus: Any) -> None:
    """Close it now; the library would leave that to the garbage collector. Raises no OSError."""
    driver = bus._i2c._i2c_bus
    try:
        driver.close()
    except OSError as error:  # Linux has closed it all the same
        log.warning("closing an I2C bus failed: %s", error)
        driver._device = None  # else it would be closed again
    bus.deinit()


class _StrictFile:
    """A device file on which a lost transfer is an error.

    A raw file of Python returns None for EAGAIN, and the driver takes that for success.
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
    """One line for people about what went wrong with a chip at `address` on /dev/i2c-`bus`.

    An error in other words than Linux's, such as one of a virtual Pi, is left to speak for itself.
    section: where the keys `bus` and `address` are, `force_sensor` or `servo`
    """
    if not isinstance(error, OSError):
        return f"{type(error).__name__}: {error}"
    if error.errno is None:
        return str(error)
    if error.strerror != os.strerror(error.errno):
        return f"{error.strerror} (error {error.errno})"
    advice = _ADVICE.get(error.errno, f"a transfer on {{bus}} failed: {error.strerror}")
    words = {"bus": f"/dev/i2c-{bus}", "address": f"{address:#04x}"}
    return f"{advice.format(**words, chip=chip, section=section)} (error {error.errno})"


def checks(bus: int, section: str) -> tuple[Check, ...]:
    """Return the checks of the bus that `section`.bus names."""
    return (
        Check("i2c bus", lambda machine: _bus(machine, bus, section), ("pi",)),
        Check("i2c speed", lambda machine: _speed(machine, bus), ("pi",)),
    )


def _bus(machine: Machine, number: int, section: str) -> Result:
    """Check the device file, and whether this user may use it."""
    device = machine.path(f"/dev/i2c-{number}")
    if not device.exists():
        others = sorted(path.name for path in machine.path("/dev").glob("i2c-*"))
        seen = f"; there is {', '.join(others)}: set {section}.bus" if others else ""
        return fail(
            f"/dev/i2c-{number} does not exist{seen}",
            "dtparam=i2c_arm=on in /boot/firmware/config.txt, module i2c-dev loaded; restart",
        )
    if not os.access(device, os.R_OK | os.W_OK):
        found = device.stat()
        if found.st_gid == 0 or not found.st_mode & stat.S_IWGRP:
            return fail(
                f"/dev/i2c-{number} may be used by user {name_of(found.st_uid)} only",
                "sudo make install-pi, then restart: its udev rule gives the bus to group i2c",
            )
        group = device.group()
        return fail(
            f"/dev/i2c-{number} may be used by group {group} only",
            f"sudo usermod -aG {group} $USER, then log in again; the systemd service is in it",
        )
    return ok(f"/dev/i2c-{number} is there and may be used")


def _speed(machine: Machine, number: int) -> Result:
    """Check the speed of the bus that the device tree states."""
    found = _set_speed(machine, number)
    if found is None:
        return skipped("the kernel does not tell the speed of this bus")
    if found < FAST_BUS:
        return warning(
            f"{found / 1e3:.0f} kbit/s: fewer samples per tick than at {FAST_BUS / 1e3:.0f}",
            f"dtparam=i2c_arm_baudrate={FAST_BUS} in /boot/firmware/config.txt, then restart",
        )
    if _CORE_CLOCK.search(machine.model):
        return ok(
            f"{found / 1e3:.0f} kbit/s are set; less while this Pi's core clock is lowered, see "
            "docs/how-to/wiring.md"
        )
    return ok(f"{found / 1e3:.0f} kbit/s")


def _set_speed(machine: Machine, number: int) -> int | None:
    """The bus's clock in the device tree [bit/s]; None if the tree does not name it."""
    for folder in _ADAPTERS:
        place = machine.path(f"{folder}/i2c-{number}/of_node/clock-frequency")
        with suppress(OSError):
            return int.from_bytes(place.read_bytes(), "big")
    return None
