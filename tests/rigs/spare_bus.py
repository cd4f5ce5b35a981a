"""The number of an I2C bus for tests that need one which nobody else drives."""

import atexit
import socket
from functools import cache

LOWEST, BEYOND = 100, 178
ANOTHER = BEYOND - LOWEST
"""So much larger is the number of a second bus, spare as well."""


@cache
def spare_bus() -> int:
    """A bus that no machine has, and no test of another process as long as this one lives."""
    for bus in range(LOWEST, BEYOND):
        held = socket.socket(socket.AF_UNIX)
        try:
            held.bind(f"\0fishd-tests-i2c-{bus}")  # a name without a file, gone with its socket
        except OSError:
            held.close()
            continue
        atexit.register(held.close)
        return bus
    raise AssertionError("no bus is spare")
