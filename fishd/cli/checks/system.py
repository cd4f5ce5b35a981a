"""Checks of what fishd runs on: the model of the Pi, and whether its system knows all of it."""

from fishd.cli.checks.base import Check, Context, Result, fail, ok, warning

_OLDEST = "brcm,bcm2835"
"""The one slow core of a Pi 1, Zero and Zero W, in the device tree."""
_HEADER_OF_PI_5 = "1f000*"
"""Devices of the RP1, the chip that a Pi 5 has its header on, where the kernel knows it."""
_RASPBERRY_PI_OS = "use Raspberry Pi OS, or see 'Which system' in docs/installing.md"


def model(context: Context) -> Result:
    """Robot `pi` is for a Raspberry Pi that is fast enough."""
    if "Raspberry Pi" not in context.model:
        return warning(
            f"this machine is no Raspberry Pi: {context.model or 'it does not say what it is'}",
            "run fishd on the Pi, or set robot: simulated or virtual-pi",
        )
    if _OLDEST in context.text("/proc/device-tree/compatible").split("\0"):
        return fail(
            f"{context.model} has one core of ARMv6, too slow: its ticks would take 7 ms, one in a "
            "hundred more than 10 ms, and a release of the servo 7 s",
            "use a Pi Zero 2 W, 3, 4 or 5",
        )
    return ok(context.model)


def system(context: Context) -> Result | None:
    """Raspberry Pi OS and plain Debian look alike, but only one knows all of the Pi."""
    if "Raspberry Pi" not in context.model:
        return None
    name = _name(context)
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


def _name(context: Context) -> str:
    """Such as Raspberry Pi OS (Debian GNU/Linux 12 (bookworm)); the two have one os-release."""
    lines = dict(
        line.split("=", 1) for line in context.text("/etc/os-release").splitlines() if "=" in line
    )
    debian = lines.get("PRETTY_NAME", "this system").strip('"')
    return f"Raspberry Pi OS ({debian})" if context.path("/etc/rpi-issue").exists() else debian


CHECKS = (
    Check("model", model, ("pi",)),
    Check("system", system, ("pi",)),
)
