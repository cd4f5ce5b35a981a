"""Checks of the I2C bus: its device file, and its speed."""

import os
import re
import stat
from contextlib import suppress

from fishd.cli.checks.base import Check, Context, Result, fail, name_of, ok, skipped, warning

FAST_BUS = 400_000
"""[bit/s]"""
_ADAPTERS = ("/sys/bus/i2c/devices", "/sys/class/i2c-adapter")
"""Where the kernel lists its buses; the latter before 6.12 only."""
_CORE_CLOCK = re.compile(r"Raspberry Pi (3|4|Compute Module [34])")
"""Pis whose bus slows down with the core clock."""


def bus(context: Context) -> Result:
    """The device file, and whether this user may use it."""
    number = context.config.force_sensor.bus
    device = context.path(f"/dev/i2c-{number}")
    if not device.exists():
        others = sorted(path.name for path in context.path("/dev").glob("i2c-*"))
        seen = f"; there is {', '.join(others)}: set force_sensor.bus" if others else ""
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


def speed(context: Context) -> Result:
    """As the device tree says; big-endian."""
    found = _set_speed(context, context.config.force_sensor.bus)
    if found is None:
        return skipped("the kernel does not tell the speed of this bus")
    if found < FAST_BUS:
        return warning(
            f"{found / 1e3:.0f} kbit/s: fewer samples per tick than at {FAST_BUS / 1e3:.0f}",
            f"dtparam=i2c_arm_baudrate={FAST_BUS} in /boot/firmware/config.txt, then restart",
        )
    if _CORE_CLOCK.search(context.model):
        return ok(
            f"{found / 1e3:.0f} kbit/s are set; less while this Pi's core clock is lowered, see "
            "docs/wiring.md"
        )
    return ok(f"{found / 1e3:.0f} kbit/s")


def _set_speed(context: Context, number: int) -> int | None:
    """The bus's clock in the device tree [bit/s]; None where there is none."""
    for folder in _ADAPTERS:
        place = context.path(f"{folder}/i2c-{number}/of_node/clock-frequency")
        with suppress(OSError):
            return int.from_bytes(place.read_bytes(), "big")
    return None


CHECKS = (
    Check("i2c bus", bus, ("pi",)),
    Check("i2c speed", speed, ("pi",)),
)
