"""Gait of a track: means over whole beats, and coverage of the interval."""

import numpy as np
import pytest

from fishd.virtual.swimmer.gait import gait, mass
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.settings import SwimmerSettings
from fishd.virtual.swimmer.track import COLUMNS

TICK, PERIOD = 0.01, 0.4
SETTINGS = SwimmerSettings()


def track(seconds: float, speed: Array | float = 0.1, **columns: float) -> dict[str, Array]:
    """Return the track of a fish that beats at 2.5 Hz; speed: of each tick, or of all [m/s]"""
    ticks = round(seconds / TICK)
    time = TICK * np.arange(1, ticks + 1)
    phase = np.arange(ticks) % round(PERIOD / TICK)
    track_columns = {name: np.full(ticks, columns.get(name, 0.0)) for name in COLUMNS}
    x = -np.cumsum(np.broadcast_to(speed, ticks)) * TICK
    beat = {"time": time, "x": x, "phi_c": np.where(phase < 20, -0.42, 0.42)}
    tail = 0.012 * np.cos(2 * np.pi * phase / 40)
    return track_columns | beat | {"tail_lowest": tail, "tail_highest": tail}


def test_means_are_those_of_whole_beats() -> None:
    result = gait(track(4.2, muscle_power=0.06, thrust_power=0.01, lateral_power=0.03), SETTINGS)
    assert result.beats == 9  # from the first upward reversal, at 0.2 s, to that at 3.8 s
    assert result.frequency == pytest.approx(1 / PERIOD)
    assert result.speed == pytest.approx(0.1)
    assert result.tail_width == pytest.approx(0.24)
    assert result.strouhal == pytest.approx(2.5 * 0.024 / 0.1)
    assert result.froude_efficiency == pytest.approx(0.25)
    assert result.cost_of_transport == pytest.approx(0.06 / (mass(SETTINGS) * 0.1))
    assert result.reynolds == pytest.approx(1e4)


def test_a_ripple_within_the_beat_is_no_uncertainty() -> None:
    ripple = 0.1 + 0.05 * np.sin(2 * np.pi * TICK / PERIOD * np.arange(2000))
    assert gait(track(20.0, ripple), SETTINGS).speed_ci95 == pytest.approx(0.0, abs=1e-9)


def test_a_fish_that_does_not_beat_or_get_on_has_no_efficiency() -> None:
    for still in (gait(track(2.0) | {"phi_c": np.zeros(200)}, SETTINGS),
                  gait(track(2.0, -0.01), SETTINGS)):  # fmt: skip
        assert still.strouhal is still.froude_efficiency is still.cost_of_transport is None
    assert gait(track(2.0) | {"phi_c": np.zeros(200)}, SETTINGS).beats == 0


def rising(by: float, seconds: float = 20.0) -> Array:
    """Return the speeds of a fish that gains this fraction per second, from 0.1 m/s on."""
    return 0.1 * (1.0 + by * TICK * np.arange(round(seconds / TICK)))


def test_a_fish_that_still_speeds_up_is_said_to_and_the_interval_widens_too_little() -> None:
    result = gait(track(20.0, rising(0.01)), SETTINGS)
    assert result.speed_trend == pytest.approx(0.01 / 1.1, rel=0.02)
    assert result.speed_ci95 < 0.12 - result.speed
    slower = gait(track(20.0, rising(-0.01)), SETTINGS)
    assert slower.speed_trend < 0.0


@pytest.mark.parametrize(
    "speed",
    [
        rising(0.0008),  # hardly matters
        0.1 + 0.05 * np.sin(2 * np.pi * TICK / PERIOD * np.arange(2000)),
        0.1 + 0.002 * np.sin(2 * np.pi / 500 * np.arange(2000)),
    ],
    ids=["a trend too small to matter", "a ripple within the beat", "speeds up and down"],
)
def test_a_fish_whose_halves_agree_is_steady(speed: Array) -> None:
    assert gait(track(20.0, speed), SETTINGS).speed_trend is None


def test_the_interval_covers_the_mean_although_beats_are_alike() -> None:
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(200):
        wander, noise = np.zeros(3000), rng.normal(size=3000)
        for index in range(1, 3000):  # correlated over 0.5 s
            wander[index] = 0.98 * wander[index - 1] + noise[index]
        result = gait(track(30.0, 0.1 + 0.002 * wander), SETTINGS)
        held += abs(result.speed - 0.1) <= result.speed_ci95
    assert 180 <= held <= 199
