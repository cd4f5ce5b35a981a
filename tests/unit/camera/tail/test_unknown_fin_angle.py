"""Fin angles that cannot be known, and the reasons that are given."""

import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from rigs import faulty_films
from rigs.filmed_tail import Film, FilmedTail, Knock, Thing, rest_before, sine
from rigs.measured_tail import CASES, WEB, find_errors, learn, measure

from fishd.camera.tail.learned import Learned
from fishd.camera.tail.meter import TailMeter
from fishd.core.tail_reading import TailReading

pytestmark = pytest.mark.slow
FILM = CASES["plain"]
BEGIN_S = 7.0
NAMED = ("knock by 50 mrad", "knock by 100 mrad", "turned mount")
LAMP = "a lamp is mirrored on the tail at column"
FOREIGN = "something else moves near column"
NO_SHAPE = "the tail does not have the learned shape"
MOVED = r"the zero has moved by (4[0-9]|5[0-9]) mrad: learn again"


@pytest.fixture
def learned() -> Learned:
    return learn(FILM)


def swims_past(radius: float) -> Thing:
    return Thing((-0.85, -0.1), (0.15, 0.0), (2.0 * radius, radius))


FAULTS = {
    "a lamp mirrored on the fin": (replace(FILM, glare=(0.65, 0.42, 0.03)), LAMP),
    "a lamp mirrored where the fin begins": (replace(FILM, glare=(0.5, 0.375, 0.03)), LAMP),
    "bubbles": (replace(FILM, bubbles=30), NO_SHAPE),
    "something that swims past": (replace(FILM, things=(swims_past(0.03),)), FOREIGN),
    "something large that swims past": (replace(FILM, things=(swims_past(0.06),)), FOREIGN),
    "a camera that is knocked": (replace(FILM, knock=Knock(BEGIN_S, 0.05)), MOVED),
    "a camera that is knocked to the other side": (
        replace(FILM, knock=Knock(BEGIN_S, -0.05)),
        MOVED,
    ),
    "a mount that is turned": (replace(FILM, yaw=0.05), MOVED),
    "a swing larger than learned": (replace(FILM, motion=sine(0.62)), "mrad are beyond the swing"),
    "a tail that left": (replace(FILM, length=0.01), "no tail where it was learned"),
    "a fin that broke off": (replace(FILM, length=0.3), "too little of the fin is seen"),
    "high waves": (replace(FILM, waves=3.0), NO_SHAPE),
}
"""Films and a pattern of the reason, by the fault."""


@cache
def read(fault: str) -> list[TailReading]:
    film, pattern = FAULTS[fault]
    return measure(film, learn(FILM), BEGIN_S, BEGIN_S + (3.0 if pattern == FOREIGN else 2.0))


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_and_no_angle_is_wrong(fault: str) -> None:
    (film, pattern), readings = FAULTS[fault], read(fault)
    assert any(re.search(pattern, reading.reason) for reading in readings)
    assert all((reading.alpha is None) == bool(reading.reason) for reading in readings)
    if find_errors(film, readings).known:
        assert find_errors(film, readings).worst < 0.03


@pytest.mark.parametrize("fault", ["something that swims past", "something large that swims past"])
def test_what_swims_past_does_not_move_the_zero(fault: str) -> None:
    assert not any("the zero" in reading.reason for reading in read(fault))


@pytest.mark.parametrize("fault", ["bubbles", "a lamp mirrored on the fin"])
def test_pictures_between_faults_are_measured(fault: str) -> None:
    assert find_errors(FAULTS[fault][0], read(fault)).known > 0.7


@pytest.mark.parametrize(
    "fault", [{"knock": Knock(5.5, 0.05)}, {"yaw": 0.05}], ids=["knock", "mount"]
)
def test_a_turn_is_seen_in_rough_water(fault: dict[str, Any]) -> None:
    film = CASES[WEB]
    readings = measure(replace(film, **fault), learn(film), 5.0, 7.0)
    pattern = r"the zero has moved by [3-7]\d mrad: learn again"
    assert any(re.search(pattern, reading.reason) for reading in readings)
    begin = fault["knock"].time if "knock" in fault else 5.0
    assert not any(reading.alpha is not None for reading in readings if reading.time > begin)


ROUGH, HIDDEN = "rough water", "rough water, body not in view"


@pytest.mark.parametrize(
    ("water", "fault"),
    [
        *(("still water", fault) for fault in faulty_films.FAULTS),
        (ROUGH, "turned mount"),
        *((HIDDEN, fault) for fault in NAMED),
    ],
)
def test_fewer_than_one_angle_in_a_hundred_is_wrong(water: str, fault: str) -> None:
    film = replace(faulty_films.FILMS[water], seed=7)
    outcome = faulty_films.fail(film, fault, 7, until=8.0)
    assert outcome.wrong < 0.01
    if fault in NAMED:
        assert outcome.told_s < 2.0


def test_waves_too_high_for_a_picture_are_in_the_uncertainty(learned: Learned) -> None:
    film = replace(FILM, waves=1.0)
    known = [r for r in measure(film, learned, BEGIN_S, BEGIN_S + 2.0) if r.alpha is not None]
    errors = [abs(r.alpha - film.motion(np.array(r.time))) for r in known if r.alpha is not None]
    inside = [e < (r.uncertainty or 0.0) for e, r in zip(errors, known, strict=True)]
    assert len(inside) > 10
    assert np.mean(inside) > 0.9


def test_a_picture_that_is_frozen_where_the_fin_turns_back_is_not_measured(
    learned: Learned,
) -> None:
    film = replace(FILM, repeated=(3.125, 9.0))  # at the largest angle
    readings = measure(film, learned, 3.0, 4.0)
    assert {r.reason for r in readings if r.time > 3.17} == {"the camera repeats a picture"}


LOW = Film(height=250, motion=rest_before(1.0, sine(0.3)))
RIGHT = Film(root=(0.42, 0.0))


@pytest.mark.parametrize(
    ("reason", "film", "change"),
    [
        (
            "the tail leaves the picture at the bottom",
            replace(LOW, root=(0.22, 0.03)),
            {"motion": sine(0.37)},
        ),
        (
            "the tail leaves the picture at the top",
            replace(LOW, root=(0.22, -0.03)),
            {"motion": sine(0.37)},
        ),
        (
            "the camera has moved by 38 px: learn again",
            RIGHT,
            {"knock": Knock(0.0, shift=(0.06, 0.0))},
        ),
    ],
)
def test_a_tail_that_leaves_the_picture_is_lost_at_a_side(
    reason: str, film: Film, change: dict[str, Any]
) -> None:
    changed = replace(film, **change)
    readings = measure(changed, learn(film), BEGIN_S, BEGIN_S + 1.0)
    assert reason in {r.reason for r in readings}
    assert find_errors(changed, readings).worst < 0.03


def test_the_light_behind_a_tail_is_not_taken_for_a_mirrored_lamp() -> None:
    film = Film(water=275.0)
    readings = measure(replace(film, bend=0.3), learn(film), 4.0, 5.0)
    reasons = {reading.reason for reading in readings}
    assert NO_SHAPE in reasons
    assert not any("lamp" in reason for reason in reasons)


def test_pictures_of_another_size_are_refused(learned: Learned) -> None:
    reading = TailMeter(learned).read(0.0, FilmedTail(Film(width=320, height=240)).picture(0.0))
    assert reading.alpha is None
    assert reading.reason == (
        "the picture has 320 × 240 pixels, but the tail was learned from 640 × 480: learn again"
    )


def test_a_picture_that_the_camera_repeats_is_measured_once(learned: Learned) -> None:
    meter, film = TailMeter(learned), FilmedTail(FILM)
    meter.read(3.0, film.picture(3.0))
    picture = film.picture(3.02)
    assert meter.read(3.02, picture).alpha is not None
    assert meter.read(3.04, picture).reason == "the camera repeats a picture"
    assert meter.read(3.06, film.picture(3.06)).alpha is not None


def test_equal_pictures_of_a_fish_at_rest_are_measured(learned: Learned) -> None:
    meter, picture = TailMeter(learned), FilmedTail(FILM).picture(0.5)
    assert [meter.read(time, picture).alpha is None for time in (0.5, 0.53, 0.56)] == [False] * 3


def test_a_fin_that_jumps_is_not_believed(learned: Learned) -> None:
    meter, film = TailMeter(learned), FilmedTail(FILM)
    assert meter.read(2.0, film.picture(2.0)).alpha is not None
    jump = meter.read(2.01, film.picture(2.125))  # from 0 to 0.42 rad
    assert jump.reason == "the fin jumped, or something else looks like it"
