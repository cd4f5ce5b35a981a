"""Checks of what drives the servo: pigpiod, the kernel's PWM, or GPIO pins."""

import os
import re
import time

from msgspec.structs import replace

from fishd.cli.checks.base import Check, Context, Result, fail, ok, skipped, warning
from fishd.clock import SystemClock
from fishd.errors import ServoError

SLOW_ANSWER = 5e-3
"""An answer of pigpiod that takes longer may keep a tick waiting [s]."""
_DEBUG = "/sys/kernel/debug"
_LINE = re.compile(r"\(GPIO(?P<pin>\d+)\s*\|(?P<user>[^)]*?)\s*\)")


def pigpiod(context: Context) -> Result | None:
    """Through the client that fishd itself uses, whose every step has a time limit."""
    settings = context.config.servo
    if settings.driver != "pigpio":
        return None
    if context.config.robot == "pi" and "Raspberry Pi 5" in context.model:
        return fail("pigpio does not work on a Pi 5", "set servo.driver: sysfs-pwm")
    from fishd.hardware.pigpio_client import opened

    virtual = context.config.robot == "virtual-pi"
    try:
        with opened(settings.pigpio) as client:
            began = time.monotonic()
            version = client.get_pigpio_version()
            took = time.monotonic() - began
    except ServoError as error:
        frozen = "answer" in str(error)
        if virtual:
            mend = "fishctl virtual-pi run; its port must be that of servo.pigpio.port"
        elif frozen:
            mend = "sudo systemctl restart pigpiod"
        else:
            mend = _start_pigpiod(context)
        return fail(str(error), mend)
    message = f"version {version} answers in {took * 1e3:.2f} ms"
    if took > SLOW_ANSWER:
        return warning(f"{message}: too slow for a tick", "see what else loads this machine")
    return ok(message)


def _start_pigpiod(context: Context) -> str:
    """What to do where nobody answers: Debian has no package of it, Raspberry Pi OS 12 has."""
    if any(context.path(f"{folder}/pigpiod").exists() for folder in ("/usr/bin", "/usr/local/bin")):
        return "sudo systemctl enable --now pigpiod"
    if context.path("/etc/rpi-issue").exists():
        return "sudo apt install pigpio; where there is no such package, servo.driver: sysfs-pwm"
    return "Debian has no pigpiod: set servo.driver: sysfs-pwm, or build it from its sources"


def pwm(context: Context) -> Result | None:
    """Open the channel as fishd does, and leave everything as it was."""
    settings = context.config.servo
    if settings.driver != "sysfs-pwm":
        return None
    if occupied := context.occupied("owns the channel; see daemon"):
        return occupied
    from fishd.hardware.pwm_channel import PwmChannel
    from fishd.hardware.pwm_pulses import PATIENCE

    root = str(context.path(settings.sysfs.root))
    channel = PwmChannel(replace(settings, sysfs=replace(settings.sysfs, root=root)), SystemClock())
    try:
        channel.open(PATIENCE)
        duty = channel.read("enable") and channel.read("duty_cycle")
    except ServoError as error:
        return fail(
            str(error), "do as it says, and restart; 'make install-pi' gives group gpio its files"
        )
    finally:
        channel.close()
        if channel.exported:
            channel.unexport()
    if duty:
        return warning(f"{channel.path}: pulses are on, but no fishd is running", "fishctl release")
    return ok(f"{channel.path} may be written to")


def pins(context: Context) -> Result | None:
    """Who holds the pins that are configured, as far as the kernel knows."""
    config = context.config
    wanted = {config.panel.estop_gpio: "panel.estop_gpio", config.panel.led_gpio: "panel.led_gpio"}
    wanted[config.servo.gpio] = "servo.gpio"
    wanted.pop(None, None)
    text = context.text(f"{_DEBUG}/gpio")
    if not text:
        return skipped(_why_unseen(context))
    if occupied := context.occupied("uses its pins"):
        return occupied
    users = {int(found["pin"]): found["user"].strip() for found in _LINE.finditer(text)}
    taken = [
        f"GPIO{pin} ({key}) is used by {users[pin]}"
        for pin, key in wanted.items()
        if pin is not None and users.get(pin)
    ]
    if taken:
        return warning(
            "; ".join(taken), "stop that program, remove its dtoverlay, or choose another pin"
        )
    return ok(", ".join(f"GPIO{pin}" for pin in wanted) + " free")


def _why_unseen(context: Context) -> str:
    if os.geteuid() != 0:
        return "only root can see who uses GPIO pins: sudo fishctl doctor"
    try:
        mounted = any(context.path(_DEBUG).iterdir())
    except OSError as error:
        return f"who uses GPIO pins cannot be seen: {_DEBUG}: {error.strerror}"
    if mounted:
        return f"this kernel does not say who uses GPIO pins: there is no {_DEBUG}/gpio"
    return (
        f"who uses GPIO pins cannot be seen, debugfs is not mounted: mount -t debugfs none {_DEBUG}"
    )


CHECKS = (
    Check("pigpiod", pigpiod, ("pi", "virtual-pi")),
    Check("pwm", pwm, ("pi", "virtual-pi")),
    Check("gpio pins", pins, ("pi",)),
)
