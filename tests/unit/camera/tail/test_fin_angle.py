"""Fin angle from pictures, against the true one of films."""

from dataclasses import replace

import numpy as np
import pytest
from rigs.filmed_board import calibrate
from rigs.filmed_tail import Film, backlash, random_motion
from rigs.measured_tail import (
    ASKED,
    ASKED_CALIBRATED,
    BENDING,
    BENT,
    CASES,
    WEB,
    find_errors,
    learn,
    measure,
)

from fishd.camera.tail.learned import Learned

pytestmark = pytest.mark.slow


@pytest.fixture
def learned() -> Learned:
    return learn(CASES["plain"])


@pytest.mark.parametrize("case", [case for case in CASES if any(ASKED[case])])
def test_its_errors_are_small(case: str) -> None:
    film = CASES[case]
    max_rms, max_error = ASKED[case]
    learned = learn(film)
    errors = find_errors(film, measure(film, learned, 5.0, 7.5))
    assert errors.known > 0.95
    assert abs(errors.zero) < 0.5e-3 + learned.zero_ci95
    if max_rms is not None:
        assert 1e3 * errors.rms < max_rms
    if max_error is not None:
        assert 100 * abs(errors.alpha_max) < max_error


@pytest.mark.parametrize("case", BENT)
def test_a_calibrated_view_is_corrected(case: str) -> None:
    film = CASES[case]
    lens = calibrate(film)
    errors = find_errors(film, measure(film, learn(film, lens), 5.0, 7.5))
    assert errors.known > 0.95
    assert errors.covered > 0.95
    assert 1e3 * errors.rms < 2.0
    assert 100 * abs(errors.alpha_max) < ASKED_CALIBRATED


def test_its_uncertainty_is_that_of_the_waves() -> None:
    readings = measure(CASES[WEB], learn(CASES[WEB]), 5.0, 7.0)
    errors = find_errors(CASES[WEB], readings)
    typical = np.median([reading.uncertainty for reading in readings if reading.uncertainty])
    assert errors.covered > 0.9
    assert 1.2 * errors.rms < typical < 4.0 * errors.rms


def test_a_random_command_is_measured_without_delay_or_scale() -> None:
    film = replace(CASES[BENDING], motion=random_motion(1, 10.0))
    readings = measure(film, learn(CASES[BENDING]), 5.0, 8.0)
    times = np.array([reading.time for reading in readings])
    angles = np.array([reading.alpha for reading in readings], float)
    known = np.isfinite(angles)
    assert known.mean() > 0.9
    times, angles = times[known], angles[known]
    truth = film.motion(times)
    rate = (film.motion(times + 1e-3) - film.motion(times - 1e-3)) / 2e-3
    table = np.stack([truth, rate, np.ones(len(times))], axis=1)
    scale, delay, _ = np.linalg.lstsq(table, angles, rcond=None)[0]
    assert scale == pytest.approx(1.0, abs=0.02)
    assert delay == pytest.approx(0.0, abs=1e-3)


def test_the_play_of_a_drive_is_seen(learned: Learned) -> None:
    half_width = 0.0094
    instruction = Film(motion=backlash(0.0)).motion
    readings = measure(Film(motion=backlash(half_width)), learned, 4.0, 8.0)
    times = np.array([reading.time for reading in readings])
    lag = instruction(times) - np.array([reading.alpha for reading in readings], float)
    rate = instruction(times + 1e-3) - instruction(times - 1e-3)
    middle = np.abs(instruction(times)) < 0.15
    loop = lag[middle & (rate > 0.0)].mean() - lag[middle & (rate < 0.0)].mean()
    assert loop == pytest.approx(2.0 * half_width, abs=1.5e-3)


def test_another_light_does_not_change_it(learned: Learned) -> None:
    film = Film(water=110.0, tail=37.0)
    errors = find_errors(film, measure(film, learned, 5.0, 6.0))
    assert errors.known == 1.0
    assert 1e3 * errors.worst < 5.0


def test_its_midline_leads_from_the_root_to_the_tip(learned: Learned) -> None:
    reading = measure(Film(), learned, 2.0, 2.1)[0]
    assert len(reading.midline) == 16
    assert reading.midline[0] == pytest.approx(learned.root)
    assert reading.midline[-1] == pytest.approx(reading.tip)
    assert all(np.diff([x for x, _ in reading.midline]) > 0.0)


def test_the_rows_of_a_rolling_shutter_have_their_own_times(learned: Learned) -> None:
    film = Film(read_out=0.02)
    readings = measure(film, learned, 5.0, 6.0)
    low = max(readings, key=lambda reading: reading.alpha or 0.0)
    high = min(readings, key=lambda reading: reading.alpha or 0.0)
    phase = (low.time - high.time) * 30.0 % 1.0 / 30.0
    # The fin is 150 rows lower, of 480 that are read in 20 ms.
    assert phase == pytest.approx(0.02 * 150 / 480, abs=2e-3)
