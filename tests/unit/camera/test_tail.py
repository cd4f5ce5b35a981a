"""Position of the tail in a picture."""

from functools import cache

import numpy as np
import pytest
from msgspec.structs import replace
from rigs import filmed_swim
from rigs.filmed_swim import filmed
from rigs.pictures import WEB

from fishd.camera.latency import find_tail_positions
from fishd.camera.simulated import DEFAULT, SimulatedCameraSettings

swum = cache(filmed_swim.swum)  # ticks are immutable


@pytest.mark.parametrize("camera", [DEFAULT, WEB, replace(DEFAULT, off_axis=6.0, tilt=0.1)])
@pytest.mark.parametrize("light_tail", [False, True])
def test_its_position_follows_the_fin(camera: SimulatedCameraSettings, light_tail: bool) -> None:
    ticks = swum(10.0)
    camera = replace(camera, rate=None, latency=0.0, jitter=0.0)
    pictures = np.stack([frame.pixels for frame in filmed(ticks, camera)])
    positions = find_tail_positions(255 - pictures if light_tail else pictures)
    angles = [float(tick.alpha) for tick in ticks[1:]]  # type: ignore[arg-type]
    assert np.corrcoef(positions, angles)[0, 1] > 0.985


def test_it_lies_to_the_side_of_the_higher_rows_where_it_is_bent_to_them() -> None:
    ticks = swum(20.0)
    frames = filmed(ticks, replace(DEFAULT, rate=None, latency=0.0))
    positions = find_tail_positions(np.stack([frame.pixels for frame in frames]))
    most = int(np.argmax([float(tick.alpha) for tick in ticks[1:]]))  # type: ignore[arg-type]
    assert 3.0 < positions[most] < 20.0
