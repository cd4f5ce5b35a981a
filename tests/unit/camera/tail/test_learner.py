"""Learning of the tail, the ground and the zero."""

import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest
from rigs.filmed_tail import FIN_FROM, Film, FilmedTail, rest_before, sine
from rigs.measured_tail import CASES, WEB, learn

from fishd.camera.tail.learner import CannotLearn, Learner

pytestmark = pytest.mark.slow
SMALL = Film(width=320, height=240)


def test_a_dark_tail_is_known_with_its_fin_and_swing() -> None:
    learned = learn(CASES["plain"])
    assert learned.tail_level < 120
    assert learned.fin[1] == pytest.approx(1.0 - FIN_FROM, abs=0.08)
    assert learned.span == pytest.approx((-0.42, 0.42), abs=0.01)
    assert learned.zero_ci95 < 2e-3
    assert learned.length == pytest.approx(0.55 * 640, rel=0.1)


def test_a_light_tail_is_known() -> None:
    assert learn(replace(SMALL, water=60, tail=170)).tail_level > 120


@pytest.mark.parametrize("film", [CASES["plain"], CASES["faint"]], ids=["plain", "faint"])
def test_a_small_swing_which_never_uncovers_the_axis_is_learned(film: Film) -> None:
    learned = learn(replace(film, motion=rest_before(1.0, sine(0.04))))
    assert learned.tail_level < 120
    assert learned.span == pytest.approx((-0.04, 0.04), abs=4e-3)


def test_without_a_rest_the_zero_is_the_middle_of_the_swing_and_less_well_known() -> None:
    learned = learn(replace(SMALL, motion=sine()))
    assert learned.zero_ci95 == 0.02
    assert learned.zero == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(
    ("film", "message"),
    [
        (replace(SMALL, motion=sine(0.0)), "^nothing swings: let the fish swim"),
        (replace(SMALL, length=0.01), "^nothing swings: let the fish swim"),
        (replace(SMALL, motion=rest_before(1.0, sine(0.02))), "^too little swing to learn from"),
        (
            replace(
                SMALL, motion=lambda time: 0.2 * (1.0 - np.cos(12.0 * np.maximum(time - 1, 0)))
            ),
            "^too little swing to learn from: from -?[0-9]+ to [34][0-9]+ mrad; 30 mrad to both",
        ),
        (replace(SMALL, height=110), "^the tail leaves the picture at the (top|bottom)"),
        (
            replace(SMALL, width=200, root=(0.22, 0.0), length=0.9),
            "leaves the picture at the right",
        ),
    ],
    ids=["rest", "no tail", "a small swing", "a swing to one side", "a low picture", "a long tail"],
)
def test_what_cannot_be_learned_is_named(film: Film, message: str) -> None:
    with pytest.raises(CannotLearn, match=message):
        learn(film)


@pytest.mark.parametrize("turn", [cv2.ROTATE_180, cv2.ROTATE_90_CLOCKWISE])
@pytest.mark.parametrize("film", [SMALL, replace(SMALL, length=0.3)], ids=["long", "short"])
def test_a_fish_whose_head_is_not_at_the_left_is_not_learned(film: Film, turn: int) -> None:
    learner = Learner()
    for shot in FilmedTail(film).shots(0.0, 4.0):
        learner.add(shot.time, np.asarray(cv2.rotate(shot.picture, turn), np.uint8))
    with pytest.raises(CannotLearn, match="turn the picture so that the head is at the left"):
        learner.finish()


def test_too_few_pictures_are_refused() -> None:
    learner = Learner()
    for shot in FilmedTail(SMALL).shots(1.0, 2.0):
        learner.add(*shot)
    with pytest.raises(CannotLearn, match=r"30 pictures are too few to learn from; 60 are needed"):
        learner.finish()


def test_pictures_of_two_sizes_are_refused() -> None:
    learner = Learner()
    learner.add(0.0, np.zeros((240, 320), np.uint8))
    with pytest.raises(CannotLearn, match="change from 320 × 240 to 640 × 480 pixels"):
        learner.add(0.1, np.zeros((480, 640), np.uint8))


def test_minutes_of_large_pictures_are_kept_in_little_memory() -> None:
    learner, picture = Learner(), np.zeros((720, 1280), np.uint8)
    tracemalloc.start()
    try:
        for number in range(2000):
            learner.add(number / 30.0, picture)
        assert tracemalloc.get_traced_memory()[0] < 36e6
    finally:
        tracemalloc.stop()


def test_the_edges_of_a_body_that_waves_move_are_not_the_tail() -> None:
    film = replace(CASES[WEB], seed=200)
    assert learn(film).root[0] == pytest.approx(film.width * film.root[0], abs=0.06 * film.width)
