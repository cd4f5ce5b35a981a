"""An emulated pigpiod in virtual time."""

import contextlib
from collections.abc import Iterator

import pytest
from rigs.pigpio_rig import PigpioBench


@pytest.fixture
def bench() -> Iterator[PigpioBench]:
    with contextlib.ExitStack() as stack:
        yield PigpioBench(stack)
