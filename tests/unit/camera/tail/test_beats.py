"""Maxima of the fin angle of whole beats."""

import math

import numpy as np
import pytest

from fishd.camera.tail.beats import Beat, average, find_maxima


def swing(
    rate: float, seconds: float = 4.0, offset: float = 0.0
) -> tuple[list[float], list[float]]:
    times = np.arange(0.0, seconds, 1.0 / rate)
    return times.tolist(), (offset + 0.4 * np.sin(math.tau * 2.0 * times + 0.3)).tolist()


@pytest.mark.parametrize("rate", [15.0, 30.0, 60.0, 97.0])
def test_a_maximum_lies_between_pictures(rate: float) -> None:
    beats = find_maxima(*swing(rate))
    assert len(beats) >= 6
    first = (0.25 - 0.3 / math.tau) / 2.0
    for beat in beats:
        assert beat.alpha_max == pytest.approx(0.4, rel=0.03 if rate < 30.0 else 0.01)
        number = round((beat.time - first) / 0.5)
        assert beat.time == pytest.approx(first + 0.5 * number, abs=8e-3)


def test_the_middle_of_the_swing_is_no_part_of_its_maximum() -> None:
    beats = find_maxima(*swing(60.0, offset=0.1))
    assert [beat.alpha_max for beat in beats] == pytest.approx([0.4] * len(beats), rel=0.01)
    assert [beat.middle for beat in beats] == pytest.approx([0.1] * len(beats), abs=3e-3)


def test_beats_with_an_unknown_reversal_are_left_out() -> None:
    times, angles = swing(30.0)
    beats = find_maxima(times, angles)
    top = int(np.argmin([abs(time - beats[2].time) for time in times]))
    unknown = [None if abs(index - top) < 3 else angle for index, angle in enumerate(angles)]
    rest = find_maxima(times, unknown)
    assert len(rest) == len(beats) - 1
    assert not any(abs(beat.time - beats[2].time) < 0.1 for beat in rest)


@pytest.mark.parametrize(
    "angles", [[], [0.1] * 5, [0.2] * 100, [None] * 100], ids=["none", "few", "still", "unknown"]
)
def test_without_a_swing_there_are_no_beats(angles: list[float | None]) -> None:
    assert find_maxima([0.03 * index for index in range(len(angles))], angles) == []


def test_their_mean_has_an_interval() -> None:
    beats = [Beat(0.0, value, 0.0) for value in (0.40, 0.41, 0.42)]
    mean, half_width = average(beats) or (0.0, 0.0)
    assert mean == pytest.approx(0.41)
    assert half_width == pytest.approx(4.30 * 0.01 / 3**0.5)
    assert average(beats[:1]) is None
