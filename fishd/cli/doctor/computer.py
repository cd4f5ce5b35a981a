"""Checks of the computer: its model, system, power, disk, and the folder of calibrations."""

import errno
import os
import shutil
from contextlib import suppress
from pathlib import Path

from fishd.assembly import state_folder
from fishd.cli.doctor.base import Context
from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.errors import ConfigError
from fishd.core.robots import RobotKind
from fishd.hardware.calibration_files import CalibrationFolder
from fishd.hardware.checks import (
    Check,
    Result,
    fail,
    ok,
    on_this_machine,
    skipped,
    user_name,
    warning,
)

LOW_DISK_BYTES, FULL_DISK_BYTES = 1e9, 50e6
"""Free space below which there is a warning, and below which the check fails [bytes]."""
_THROTTLED = "soc*/soc*:firmware/get_throttled"
"""File of the firmware in the tree of devices: below `soc`, or `soc@107c000000` on a Pi 5."""
_HISTORY_SHIFT_BITS = 16
"""Distance of the flag for the time since start from the flag for now [bits]."""
_TOO_SLOW_PROCESSOR = "brcm,bcm2835"
"""Processor of a Pi 1, Zero and Zero W, with one slow core, in the device tree."""
_HEADER_OF_PI_5 = "1f000*"
"""Devices of the RP1, the chip of the header of a Pi 5, if the kernel supports it."""
_RASPBERRY_PI_OS = "use Raspberry Pi OS, or see 'Which system' in docs/how-to/install.md"


def model(context: Context) -> Result:
    """Check that the machine is a Raspberry Pi that is fast enough."""
    if "Raspberry Pi" not in context.model:
        return warning(
            f"this machine is not a Raspberry Pi: {context.model or 'unknown model'}",
            "run fishd on the Pi, or set robot: simulated or virtual-pi",
        )
    if _TOO_SLOW_PROCESSOR in context.text("/proc/device-tree/compatible").split("\0"):
        return fail(
            f"{context.model} has one core of ARMv6, too slow: its ticks would take 7 ms, one in a "
            "hundred more than 10 ms, and a release of the servo 7 s",
            "use a Pi Zero 2 W, 3, 4 or 5",
        )
    return ok(context.model)


def system(context: Context) -> Result | None:
    """Check for Raspberry Pi OS: plain Debian looks alike, but does not support all of the Pi."""
    if "Raspberry Pi" not in context.model:
        return None
    name = _system_name(context)
    kernel = context.text("/proc/sys/kernel/osrelease") or "unknown"
    if "Raspberry Pi 5" in context.model and not any(
        context.path("/sys/bus/platform/devices").glob(_HEADER_OF_PI_5)
    ):
        return fail(
            f"{name}: its kernel, {kernel}, does not know the header of a Pi 5, so there is "
            "neither I2C nor a servo",
            _RASPBERRY_PI_OS,
        )
    if not context.path("/proc/device-tree/__overrides__").is_dir():
        servo = context.config.servo.driver
        lacks = {"sysfs-pwm": ", the PWM of the header is off", "pigpio": ", there is no pigpiod"}
        return warning(
            f"{name} with its own kernel, {kernel}: dtparam= and dtoverlay= in config.txt do "
            f"nothing{lacks.get(servo, '')}",
            _RASPBERRY_PI_OS,
        )
    return ok(f"{name}, kernel {kernel}")


def _system_name(context: Context) -> str:
    """Return a name such as Raspberry Pi OS (Debian GNU/Linux 12 (bookworm)).

    Both systems have the same os-release.
    """
    lines = dict(
        line.split("=", 1) for line in context.text("/etc/os-release").splitlines() if "=" in line
    )
    debian = lines.get("PRETTY_NAME", "this system").strip('"')
    return f"Raspberry Pi OS ({debian})" if context.path("/etc/rpi-issue").exists() else debian


def power(context: Context) -> Result:
    """Check the power supply, by the firmware or the under-voltage alarm of the kernel."""
    if flags := read_throttled(context):
        return _judge_flags(int(flags, 16))
    for monitor in sorted(context.path("/sys/class/hwmon").glob("hwmon*")):
        if context.text(f"/sys/class/hwmon/{monitor.name}/name") == "rpi_volt":
            alarm = context.text(f"/sys/class/hwmon/{monitor.name}/in0_lcrit_alarm") == "1"
            return _judge_flags(1) if alarm else ok("no under-voltage")
    return skipped("this machine does not report whether its power suffices")


def read_throttled(context: Context) -> str:
    """Return the firmware's flags of power and heat, hexadecimal; empty if there are none."""
    devices = "/sys/devices/platform"
    files = (path.relative_to(context.root) for path in context.path(devices).glob(_THROTTLED))
    return next(filter(None, (context.text(str(file)) for file in files)), "")


def _judge_flags(flags: int) -> Result:
    if flags & 1:
        return fail(
            "under-voltage: the Pi gets less than 4.63 V",
            f"use a stronger power supply and a shorter cable; {_SUPPLY_REMEDY}",
        )
    if now := [text for bit, text in _FLAGS.items() if flags >> bit & 1]:
        return warning(f"the Pi is {' and '.join(now)}", _COOL_REMEDY)
    if past := [text for bit, text in _FLAGS.items() if flags >> bit + _HISTORY_SHIFT_BITS & 1]:
        message = f"since it was started, the Pi has been {' and '.join(past)}"
        return warning(message, f"{_COOL_REMEDY}; {_SUPPLY_REMEDY}")
    return ok("no under-voltage, not throttled")


_FLAGS = {0: "under-voltage", 1: "slowed down", 2: "throttled", 3: "too hot"}
_COOL_REMEDY = "cool it, and check its power supply"
_SUPPLY_REMEDY = "power the servo from a separate supply"


def state(context: Context) -> Result:
    """Check the folder that keeps calibrations and other state of the daemon."""
    if context.running and context.running.calibrations:
        return skipped("fishd is running: it writes to its own folder")
    folder = state_folder(context.config)
    parent = _visible_folder(folder)
    if not parent.is_dir():
        return fail(
            f"{parent} is not a folder", f"move it away, or set state_folder; {folder} is needed"
        )
    if os.statvfs(parent).f_flag & os.ST_RDONLY:
        return fail(
            f"{folder}: {parent} is on a read-only file system",
            "mount it read-write ('mount' shows how it is mounted, 'dmesg' whether it broke), or "
            "set state_folder",
        )
    if not os.access(parent, os.W_OK | os.X_OK):
        return fail(
            f"{folder}: no permission to write to {parent}", _suggest_permission(context, parent)
        )
    return ok(f"{folder}" + ("" if parent == folder else ", which will be made when it is needed"))


def _suggest_permission(context: Context, folder: Path) -> str:
    """Return the remedy for a folder without write permission; its owner does not change."""
    uid = folder.stat().st_uid
    if uid == os.geteuid():
        return f"chmod u+wx {folder}, or set state_folder"
    if uid == 0 or user_name(uid) == "fishd":
        return f"run this as the user of fishd ({context.as_fishd}), or set state_folder"
    user = user_name(uid)
    return (
        f"it belongs to user {user}: run fishd and this as {user} ({context.as_user(user)}), or "
        "set state_folder to a folder that you own"
    )


def disk(context: Context) -> Result:
    """Check the free space: a full disk loses calibrations and logs."""
    parent = _visible_folder(state_folder(context.config))
    free = shutil.disk_usage(parent).free
    message = f"{free / 1e9:.1f} GB free at {parent}"
    remedy = "remove old recordings and logs (journalctl --vacuum-size=100M)"
    if free < FULL_DISK_BYTES:
        return fail(message, remedy)
    return warning(message, remedy) if free < LOW_DISK_BYTES else ok(message)


def calibrations(context: Context) -> Result:
    """Check both calibrations that fishd uses, or would use."""
    folder = CalibrationFolder(state_folder(context.config))
    if context.running and (in_use := context.running.calibrations):
        file = in_use.force_file or in_use.servo_file
        if file:
            folder = CalibrationFolder(Path(file).parent)
        result = _judge_calibrations(in_use.force, in_use.servo.date)
    else:
        try:
            newest_force = folder.newest(ForceCalibration)
            newest_servo = folder.newest(ServoCalibration)
        except ConfigError as error:
            return _judge_unreadable(context, folder.folder, str(error))
        force = newest_force[0] if newest_force else ForceCalibration()
        result = _judge_calibrations(force, newest_servo[0].date if newest_servo else "")
    with suppress(ConfigError):  # the folder of a running fishd may be unreadable
        if ignored := folder.ignored():
            remedy = result.remedy or "restore its name, or move it away"
            return warning("; ".join([result.message, *ignored]), remedy)
    return result


def _judge_calibrations(force: ForceCalibration, servo: str) -> Result:
    """Judge the calibrations in use; servo: date of that of the servo, or empty."""
    if force.is_unset:
        tared = (
            f"tared {force.tare_date}, but never calibrated"
            if force.tare_date
            else "not calibrated"
        )
        return warning(f"the force sensor is {tared}: forces are volts", "fishctl calibrate force")
    share = force.thrust_ci95(1.0)
    error = "its uncertainty is unknown" if share is None else f"a thrust is known to ± {share:.2%}"
    if not servo:
        return warning(
            f"force of {force.date} ({error}); the servo has no calibration but that of the "
            "configuration",
            "fishctl calibrate servo",
        )
    return ok(f"force of {force.date} ({error}), servo of {servo}")


def _judge_unreadable(context: Context, folder: Path, complaint: str) -> Result:
    if os.strerror(errno.EACCES) in complaint:
        return warning(complaint, f"run this as the user of fishd: {context.as_fishd}")
    if not _visible_folder(folder).is_dir():
        return fail(complaint, "mend the state folder first, see 'state folder'")
    return fail(complaint, "mend that file, or remove it: the one before is used then")


def _visible_folder(folder: Path) -> Path:
    """Return the folder, or the nearest folder above it that this user can see."""
    return next(path for path in (folder, *folder.parents) if os.access(path, os.F_OK))


def _has_hardware(kind: type[RobotKind]) -> bool:
    return kind.has_hardware


CHECKS = (
    Check("model", model, on_this_machine),
    Check("system", system, on_this_machine),
    Check("power", power, on_this_machine),
    Check("state folder", state, _has_hardware),
    Check("disk", disk),
    Check("calibrations", calibrations, _has_hardware),
)
