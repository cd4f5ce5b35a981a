"""An emulated pigpiod in virtual time."""

import contextlib
from collections.abc import Iterator

import pytest
from rigs.pigpio_rig import Bench


@pytest.fixture
def bench() -> Iterator[Bench]:
    with contextlib.ExitStack() as stack:
        yield Bench(stack)
