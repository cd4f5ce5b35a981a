"""Emulated ADS1115 behind an emulated /dev/i2c-N."""

from collections.abc import Iterator

import pytest
from rigs.force_rig import ForceRig


@pytest.fixture
def rig() -> Iterator[ForceRig]:
    with ForceRig() as rig:
        yield rig
