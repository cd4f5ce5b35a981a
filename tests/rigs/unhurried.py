"""fishd, fishctl and fishd-window without limits of time, for tests of anything but time.

A late tick, a delayed controller and an old sample are not faults, no answer of pigpiod is too
late, a measurement may miss any of its ticks, and fishd has a minute for an orderly end. `make
test-realtime` and the tests on the virtual clock check these limits.
"""

import math
import sys
from importlib import import_module

from msgspec.structs import replace

from fishd.client import Fish
from fishd.control import loop, supervisor
from fishd.control.faults import FAULTS
from fishd.core.process import shutdown
from fishd.hardware.servo import pigpio_link
from fishd.lab import session

ANSWER_TIMEOUT_S = 30.0
"""Timeout of clients for an answer of fishd [s]."""


def have_patience() -> None:
    """Remove the limits of time in this process."""
    supervisor.OVERRUN_SHARE = math.inf
    loop.MAX_SAMPLE_AGE_PERIODS = 100.0
    pigpio_link.MAX_LATE_ANSWERS = 1_000_000
    shutdown.SHUTDOWN_TIMEOUT_S = 60.0
    FAULTS["controller-slow"] = replace(FAULTS["controller-slow"], in_a_row=1_000_000)
    session.MAX_LOST_FRACTION, session.IDLE_LIMIT = 1.0, 60.0
    Fish.__init__.__kwdefaults__["timeout"] = ANSWER_TIMEOUT_S
    if link := sys.modules.get("fishd.window.fish_link"):
        # Otherwise a last resort that begins while fishd stalls stops the fish again, later.
        link.ESTOP_TIMEOUT_S = ANSWER_TIMEOUT_S  # type: ignore[attr-defined]


if __name__ == "__main__":
    # Loading it sets PYTHONSAFEPATH, which programs that a test starts would inherit.
    from fishd.__main__ import fishctl, fishd, fishd_window

    program = sys.argv.pop(1)
    if program == "fishd-window":
        import_module("fishd.window.fish_link")
    have_patience()
    {"fishd": fishd, "fishctl": fishctl, "fishd-window": fishd_window}[program]()
