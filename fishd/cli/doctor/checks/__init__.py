"""The checks of `fishctl doctor`, in the order in which they are made."""

import sys
from collections.abc import Iterator

from fishd.cli.doctor.checks import computer, drivers, service, software, timing
from fishd.cli.doctor.checks.base import INSTALL, Context
from fishd.core.errors import MissingPackage
from fishd.hardware.checks import Check, Result, fail
from fishd.hardware.packages import driver_packages


def checks(context: Context) -> Iterator[Check]:
    """Those that concern the configured robot."""
    every = (
        *software.CHECKS,
        *computer.CHECKS,
        *timing.CHECKS,
        *(drivers.checks(context) if context.robot != "simulated" else ()),
        *service.CHECKS,
    )
    return (check for check in every if context.robot in check.robots)


def examine(context: Context) -> Iterator[tuple[str, Result]]:
    """Make every check that concerns the configured robot: its name and what came out.

    A check that fails to be made is itself a failure, and does not keep the others from being made.
    """
    for check in checks(context):
        try:
            with driver_packages():
                result = check.function(context)
        except MissingPackage as error:
            mend = INSTALL if "fishd[pi]" in str(error) else f"{sys.executable} -m pip install it"
            result = fail(str(error), mend)
        except Exception as error:
            what = f"this check broke off: {type(error).__name__}: {error}"
            result = fail(what, "please report this, with the output of 'fishctl doctor --json'")
        if result is not None:
            yield check.name, result
