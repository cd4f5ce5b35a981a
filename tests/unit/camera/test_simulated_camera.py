"""Pictures of the simulated camera, and their times."""

from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace
from rigs.pictures import WEB

from fishd.camera.simulated import (
    DEFAULT,
    SimulatedCamera,
    SimulatedCameraSettings,
    Tail,
    TailPainter,
)
from fishd.core.camera_frames import Frame

CLEAR = replace(DEFAULT, noise=0.0)
TICK = 0.05


def frames_of(settings: SimulatedCameraSettings, ticks: int) -> list[Frame]:
    camera = SimulatedCamera(settings, 84)
    frames = []
    for tick in range(ticks):
        ends = (Tail(time, 0.1, 0.0) for time in (tick * TICK, (tick + 1) * TICK))
        frames += camera.frames(*ends)
    return frames


def tip(settings: SimulatedCameraSettings, alpha: float, rate: float = 0.0) -> tuple[float, float]:
    """Return the row of the tail's tip, and the width of its blur [px]."""
    column = TailPainter(settings, 84).paint(alpha, rate, 0.0)[:, 72].astype(float)
    dark = column.max() - column
    rows = np.arange(84)
    centre = float(dark @ rows / dark.sum())
    return centre, float(np.sqrt(dark @ (rows - centre) ** 2 / dark.sum()))


@pytest.mark.parametrize("tilt", [0.0, 0.1])
@pytest.mark.parametrize("alpha", [-0.3, 0.2])
def test_the_fin_is_straight_at_the_fin_angle_to_the_axis(alpha: float, tilt: float) -> None:
    picture = TailPainter(replace(CLEAR, tilt=tilt), 640, 480).paint(alpha, 0.0, 0.0).astype(float)
    columns = np.arange(340, 490)
    dark = picture.max() - picture[:, columns]
    middle = np.arange(480) @ dark / dark.sum(axis=0)
    slope, _ = line = np.polyfit(columns, middle, 1)
    assert np.arctan(slope) - tilt == pytest.approx(alpha, abs=1e-3)
    assert np.abs(middle - np.polyval(line, columns)).max() < 0.1


def test_the_skeleton_bends_smoothly_into_the_fin() -> None:
    assert tip(CLEAR, 0.0)[0] == pytest.approx(41.5, abs=0.05)
    straight = 0.74 * 84 * np.tan(0.2)  # without a skeleton
    assert tip(CLEAR, 0.2)[0] - 41.5 == pytest.approx(0.85 * straight, rel=0.05)


def test_a_fast_tail_is_smeared_by_a_long_exposure() -> None:
    still, fast = tip(CLEAR, 0.0)[1], tip(CLEAR, 0.0, 6.0)[1]
    assert fast > 1.2 * still
    assert tip(replace(CLEAR, exposure=0.0), 0.0, 3.0)[1] == pytest.approx(still)


def test_the_axis_can_be_off_and_tilted() -> None:
    assert tip(replace(CLEAR, off_axis=3.0), 0.0)[0] == pytest.approx(44.5, abs=0.05)
    shift = 0.02 * (72 - 41.5)
    assert tip(replace(CLEAR, tilt=0.02), 0.0)[0] == pytest.approx(41.5 + shift, abs=0.05)


@pytest.mark.parametrize(
    "change", [{"noise": 6.0}, {"caustics": 12.0}, {"light_drift": 0.3}, {"side_light": 20.0}]
)
def test_each_imperfection_shows(change: dict[str, float]) -> None:
    clear = TailPainter(CLEAR, 84).paint(0.0, 0.0, 5.0).astype(float)
    worse = TailPainter(replace(CLEAR, **change), 84).paint(0.0, 0.0, 5.0).astype(float)
    assert np.abs(worse - clear).mean() > 2.0


def test_the_same_seed_gives_the_same_pictures() -> None:
    first, second = frames_of(WEB, 10), frames_of(WEB, 10)
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.pixels, b.pixels)
        assert a[:2] == b[:2]
    third = frames_of(replace(WEB, seed=1), 10)
    assert not np.array_equal(first[0].pixels, third[0].pixels)


def test_a_camera_in_phase_has_a_frame_there_when_each_tick_begins() -> None:
    frames = frames_of(DEFAULT, 20)
    ends = [TICK * (tick + 1) for tick in range(20)]
    assert [frame.available for frame in frames] == pytest.approx(ends)
    assert [frame.available - frame.time for frame in frames] == pytest.approx([0.03] * 20)


@pytest.mark.parametrize("latency", [0.0, 0.05, 0.12])
@pytest.mark.parametrize("error", [-1e-12, 1e-12])
def test_frames_in_phase_are_evenly_apart_at_any_tick(latency: float, error: float) -> None:
    camera = SimulatedCamera(replace(CLEAR, latency=latency), 84)
    times = [TICK * tick + error * (tick % 3 - 1) for tick in range(20)]
    ends = [Tail(time, 0.1, 0.0) for time in times]
    frames = [frame for pair in pairwise(ends) for frame in camera.frames(*pair)]
    assert np.diff([frame.time for frame in frames]) == pytest.approx(TICK)
    there = np.array([frame.available for frame in frames])
    assert there == pytest.approx(TICK * np.round(there / TICK))
    assert there - [frame.time for frame in frames] == pytest.approx(latency)


def test_a_web_camera_runs_at_its_own_rate_and_late() -> None:
    frames = frames_of(WEB, 200)
    assert len(frames) == pytest.approx(10.0 * 30, abs=1)
    assert np.diff([frame.time for frame in frames]) == pytest.approx(1 / 30)
    late = np.array([frame.available - frame.time for frame in frames])
    assert late.mean() == pytest.approx(0.05, abs=0.002)
    assert late.std() == pytest.approx(0.005, rel=0.2)
    assert (np.diff([frame.available for frame in frames]) >= 0.0).all()
