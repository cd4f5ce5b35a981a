"""Numbers of unused I2C buses for tests."""

import atexit
import os
import socket
from functools import cache

LOWEST, BEYOND = 100, 178
ANOTHER = BEYOND - LOWEST
"""Offset of the number of a second unused bus."""


@cache
def spare_bus() -> int:
    """Return a bus that no machine has, and that no other test process uses meanwhile.

    Raises AssertionError where it is called for a constant of a module: test processes are forks of
    one that has loaded all modules, and would share the bus.
    """
    assert "PYTEST_CURRENT_TEST" in os.environ, "this is no test, but a module that is loaded"
    for bus in range(LOWEST, BEYOND):
        held = socket.socket(socket.AF_UNIX)
        try:
            held.bind(f"\0fishd-tests-i2c-{bus}")  # an abstract name, which ends with its socket
        except OSError:
            held.close()
            continue
        atexit.register(held.close)
        return bus
    raise AssertionError("no bus is spare")
