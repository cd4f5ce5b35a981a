"""Axis of motion in pictures of a simulated camera."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from rigs.pictures import WEB

from fishd.camera.axis import NoMotion, find_motion
from fishd.camera.simulated import DEFAULT, SimulatedCameraSettings, TailPainter
from fishd.core.camera_frames import Pixels

BAD = replace(WEB, contrast=50.0, noise=10.0, light_drift=0.3)


def swinging(settings: SimulatedCameraSettings, *, amplitude: float = 0.2) -> Pixels:
    painter = TailPainter(settings, 84)
    ticks = 0.05 * np.arange(200)
    angles = amplitude * np.sin(math.tau * 1.3 * ticks + settings.seed)
    rates = amplitude * math.tau * 1.3 * np.cos(math.tau * 1.3 * ticks + settings.seed)
    return np.stack([painter.paint(*state) for state in zip(angles, rates, ticks, strict=True)])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("rig", [DEFAULT, BAD])
@pytest.mark.parametrize(("off", "tilt"), [(0.0, 0.0), (-3.0, -0.02), (6.5, 0.1)])
def test_the_axis_is_found_within_a_quarter_of_a_pixel(
    rig: SimulatedCameraSettings, off: float, tilt: float, seed: int
) -> None:
    axis = find_motion(swinging(replace(rig, off_axis=off, tilt=tilt, seed=seed))).axis
    assert axis.offset == pytest.approx(off, abs=0.25)
    assert axis.tilt == pytest.approx(tilt, abs=0.02)


@pytest.mark.parametrize("rig", [DEFAULT, WEB, BAD])
@pytest.mark.parametrize("slope", [-0.3, math.pi / 8])
def test_a_steep_axis_is_found_too(rig: SimulatedCameraSettings, slope: float) -> None:
    motion = find_motion(swinging(replace(rig, tilt=slope)))
    assert motion.axis.tilt == pytest.approx(slope, abs=0.03)
    assert motion.is_certain


@pytest.mark.parametrize("off", [-30.0, 30.0])
def test_an_axis_beyond_what_is_looked_at_is_not_sure(off: float) -> None:
    assert not find_motion(swinging(replace(DEFAULT, off_axis=off), amplitude=0.1)).is_certain


def test_a_tail_that_rests_has_no_axis() -> None:
    with pytest.raises(NoMotion, match="nothing moves in these pictures but noise; let the fish"):
        find_motion(swinging(WEB, amplitude=0.0))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("seconds", [2, 5])
def test_light_that_moves_on_the_water_has_no_axis(seconds: int, seed: int) -> None:
    painter = TailPainter(replace(WEB, seed=seed), 84)
    times = np.arange(0.0, seconds, 1 / 30)
    with pytest.raises(NoMotion, match="let the fish swim"):
        find_motion(np.stack([painter.paint(0.0, 0.0, time) for time in times]))


def test_few_pictures_are_refused() -> None:
    with pytest.raises(NoMotion, match="9 pictures are too few"):
        find_motion(swinging(DEFAULT)[:9])
