"""fishd as a program that a busy machine cannot bring into a fault: for tests of anything else.

A tick that comes late, a controller that was kept from computing and a sample that is late are no
faults, and no answer of pigpiod is too late. `make test-realtime` and the tests on the virtual
clock judge them.
"""

import math

from msgspec.structs import replace

from fishd.__main__ import fishd
from fishd.control import supervisor
from fishd.control.faults import FAULTS
from fishd.hardware.servo import pigpio_link

IN_A_ROW = {"controller-slow": 1_000_000, "sensor-stale": 40}
"""Failed checks until a fault; tests wait for that of a sensor that is gone."""

if __name__ == "__main__":
    supervisor.OVERRUN_SHARE = math.inf
    pigpio_link.LATE_STREAK = 1_000_000
    for code, in_a_row in IN_A_ROW.items():
        FAULTS[code] = replace(FAULTS[code], in_a_row=in_a_row)
    fishd()
