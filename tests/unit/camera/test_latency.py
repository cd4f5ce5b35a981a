"""Delay of a camera, measured from its frames and the lateral force."""

import random
from functools import cache

import pytest
from msgspec.structs import replace
from rigs import filmed_swim
from rigs.filmed_swim import felt, filmed
from rigs.pictures import WEB

from fishd.camera.latency import NoDelay, find_latency
from fishd.camera.simulated import DEFAULT, SimulatedCameraSettings
from fishd.core.camera_frames import Frame

BAD = replace(WEB, contrast=50.0, noise=10.0, light_drift=0.3)

swum = cache(filmed_swim.swum)  # ticks and frames are immutable


@cache
def film(camera: SimulatedCameraSettings) -> list[Frame]:
    return filmed(swum(40.0), camera)


def stamped_late(frames: list[Frame], late: float) -> list[Frame]:
    """Return frames of a driver whose time stamps are late by a time [s]."""
    return [frame._replace(time=frame.time + late) for frame in frames]


@pytest.mark.slow
@pytest.mark.parametrize("late", [-0.01, 0.04])
@pytest.mark.parametrize(
    ("camera", "within"), [(DEFAULT, 1.5e-3), (BAD, 3e-3)], ids=["default", "bad"]
)
def test_the_delay_is_found_within_milliseconds_however_wrong_the_time_stamps_are(
    camera: SimulatedCameraSettings, within: float, late: float
) -> None:
    ticks = swum(40.0)
    latency = find_latency(stamped_late(film(camera), late), felt(ticks))
    assert latency.stamps == pytest.approx(late, abs=within)
    assert latency.total == pytest.approx(camera.latency, abs=within + 1e-3)
    assert abs(latency.stamps - late) < 1.5 * latency.ci95
    assert latency.ci95 < 3e-3
    assert latency.agreement > 0.95


@pytest.mark.slow
@pytest.mark.parametrize(
    "setting", ["plant.omega0=9", "plant.servo_delay=0.05", "simulation.rotation=0.05"]
)  # fmt: skip
def test_no_parameter_of_the_fish_is_needed(setting: str) -> None:
    ticks = swum(40.0, setting)
    latency = find_latency(filmed(ticks, WEB), felt(ticks))
    assert latency.stamps == pytest.approx(0.0, abs=3e-3)


def test_the_window_of_a_force_does_not_reach_back_over_ticks_that_were_skipped() -> None:
    ticks = swum(5.0)
    forces = felt([tick for tick in ticks if tick.seq % 10 > 3])
    lengths = {round(force.end - force.begin, 3) for force in forces}
    assert lengths == {0.05}


def test_ninety_nine_of_a_hundred_frames_arrive_within_what_is_said() -> None:
    latency = find_latency(film(WEB), felt(swum(40.0)))
    assert 0.055 < latency.latest < 0.07
    assert latency.arrival == pytest.approx(0.05, abs=2e-3)


def test_frames_of_another_swim_are_refused() -> None:
    frames = film(DEFAULT)
    pixels = [frame.pixels for frame in frames]
    random.Random(1).shuffle(pixels)
    mixed = [frame._replace(pixels=image) for frame, image in zip(frames, pixels, strict=True)]
    with pytest.raises(NoDelay, match=r"agree by .* only: is it the same fish"):
        find_latency(mixed, felt(swum(40.0)))


@pytest.mark.parametrize(
    ("seconds", "camera", "complaint"),
    [
        (5.0, DEFAULT, "10 s of swimming are needed"),
        (20.0, replace(DEFAULT, rate=1.0), "19 frames are too few"),
    ],
)
def test_a_short_swim_or_few_frames_are_refused(
    seconds: float, camera: SimulatedCameraSettings, complaint: str
) -> None:
    ticks = swum(seconds)
    with pytest.raises(NoDelay, match=complaint):
        find_latency(filmed(ticks, camera), felt(ticks))
