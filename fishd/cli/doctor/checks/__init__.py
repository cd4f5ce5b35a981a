"""The checks of `fishctl doctor`, in the order in which they are made."""

from collections.abc import Iterator

from fishd.cli.checks import (
    computer,
    i2c,
    sensor,
    service,
    servo,
    software,
    system,
    timing,
)
from fishd.cli.checks.base import INSTALL, Check, Context, Result, fail
from fishd.errors import MissingPackage
from fishd.hardware.packages import driver_packages

CHECKS: tuple[Check, ...] = (
    *software.CHECKS,
    *system.CHECKS,
    *computer.CHECKS,
    *timing.CHECKS,
    *i2c.CHECKS,
    *sensor.CHECKS,
    *servo.CHECKS,
    *service.CHECKS,
)


def examine(context: Context) -> Iterator[tuple[str, Result]]:
    """Make every check that concerns the configured robot: its name and what came out.

    A check that fails to be made is itself a failure, and does not keep the others from being made.
    """
    for check in CHECKS:
        if context.config.robot not in check.robots:
            continue
        try:
            with driver_packages():
                result = check.function(context)
        except MissingPackage as error:
            result = fail(str(error), INSTALL)
        except Exception as error:
            what = f"this check broke off: {type(error).__name__}: {error}"
            result = fail(what, "please report this, with the output of 'fishctl doctor --json'")
        if result is not None:
            yield check.name, result
