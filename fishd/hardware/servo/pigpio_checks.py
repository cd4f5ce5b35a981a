"""What `fishctl doctor` looks at where pigpiod makes the pulses."""

import time
from typing import TYPE_CHECKING

from fishd.core.errors import ServoError
from fishd.hardware.checks import START_VIRTUAL_PI, Machine, Result, fail, ok, warning

if TYPE_CHECKING:
    from fishd.hardware.servo.pigpio import PigpioSettings

SLOW_ANSWER = 5e-3
"""An answer of pigpiod that takes longer may keep a tick waiting [s]."""


def pigpiod(machine: Machine, settings: "PigpioSettings") -> Result:
    """Through the client that fishd itself uses, whose every step has a time limit."""
    virtual = machine.robot == "virtual-pi"
    if not virtual and "Raspberry Pi 5" in machine.model:
        return fail("pigpio does not work on a Pi 5", "set servo.driver: sysfs-pwm")
    from fishd.hardware.servo.pigpio_client import opened

    try:
        with opened(settings) as client:
            began = time.monotonic()
            version = client.get_pigpio_version()
            took = time.monotonic() - began
    except ServoError as error:
        frozen = "answer" in str(error)
        if virtual:
            mend = f"{START_VIRTUAL_PI}; its port must be that of servo.port"
        elif frozen:
            mend = "sudo systemctl restart pigpiod"
        else:
            mend = _start_pigpiod(machine)
        return fail(str(error), mend)
    message = f"version {version} answers in {took * 1e3:.2f} ms"
    if took > SLOW_ANSWER:
        return warning(f"{message}: too slow for a tick", "see what else loads this machine")
    return ok(message)


def _start_pigpiod(machine: Machine) -> str:
    """What to do where nobody answers: Debian has no package of it, Raspberry Pi OS 12 has."""
    if any(machine.path(f"{folder}/pigpiod").exists() for folder in ("/usr/bin", "/usr/local/bin")):
        return "sudo systemctl enable --now pigpiod"
    if machine.path("/etc/rpi-issue").exists():
        return "sudo apt install pigpio; where there is no such package, servo.driver: sysfs-pwm"
    return "Debian has no pigpiod: set servo.driver: sysfs-pwm, or build it from its sources"
