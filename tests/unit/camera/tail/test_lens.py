"""Calibration of lens and view from pictures of a board, through cameras whose lens is known."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec.structs import replace as changed
from numpy.typing import NDArray
from rigs.filmed_board import SQUARE_MM, FilmedBoard, calibrate, turn
from rigs.filmed_tail import Film, FilmedTail
from rigs.measured_tail import learn

from fishd.camera.tail.board import (
    COLUMNS,
    MIN_VIEWS,
    BoardWatch,
    draw_board,
    draw_svg,
    find_board,
    find_plane,
)
from fishd.camera.tail.learned import CannotUse
from fishd.camera.tail.learner import CannotLearn, Learner
from fishd.camera.tail.lens import CannotUseLens, Lens

pytestmark = pytest.mark.slow
FILM = Film(lens=-0.12, tilt=0.08)
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
SQUARE = 0.08
"""Side of a square of the board that lies in the plane, as a fraction of the width."""


@pytest.fixture
def lens() -> Lens:
    return calibrate(FILM)


@pytest.mark.parametrize(
    "film",
    [FILM, Film(lens=0.1, tilt=-0.2, aspect=1.05, seed=1), Film(width=400, height=300, seed=2)],
)
def test_a_picture_is_mapped_to_the_plane_of_the_tail(film: Film) -> None:
    lens = calibrate(film)
    edge = 0.1 * film.width
    columns, rows = np.meshgrid(
        np.linspace(edge, film.width - edge, 9), np.linspace(edge, film.height - edge, 7)
    )
    plane = np.stack([columns, rows], axis=2).reshape(-1, 2)
    mapped = lens.to_plane(FilmedTail(film)._project(plane, -1.0))
    similarity, _ = cv2.estimateAffinePartial2D(mapped, plane)
    error = mapped @ similarity[:, :2].T + similarity[:, 2] - plane
    assert np.hypot(*error.T).max() < 6e-4 * film.width
    assert lens.pixels_per_mm is not None
    scale = lens.pixels_per_mm * math.hypot(*similarity[0, :2])
    assert scale == pytest.approx(SQUARE * film.width / SQUARE_MM, rel=1e-3)
    # In the middle, its pixels are those of the picture.
    middle = 0.5 * np.array([film.width - 1, film.height - 1])
    assert lens.to_plane(middle) == pytest.approx(middle, abs=1e-3)
    assert math.atan2(similarity[1, 0], similarity[0, 0]) == pytest.approx(0.0, abs=1e-3)


def test_a_reduced_picture_is_mapped_to_a_reduced_plane(lens: Lens) -> None:
    places = np.array([[100.0, 50.0], [300.0, 400.0]])
    half = lens.to_plane((places + 0.5) / 2.0 - 0.5, factor=2.0)
    assert (half + 0.5) * 2.0 - 0.5 == pytest.approx(lens.to_plane(places))


def test_a_lens_without_a_plane_has_no_distortion_and_square_pixels() -> None:
    film = Film(lens=-0.12, aspect=1.05)
    lens = changed(calibrate(film), plane=IDENTITY)
    square = np.array([[-100.0, 0.0], [100.0, 0.0], [0.0, -100.0], [0.0, 100.0]])
    left, right, top, bottom = lens.to_plane(
        FilmedTail(film)._project(square + np.array([319.5, 239.5]), 0.0)
    )
    assert right[0] - left[0] == pytest.approx(bottom[1] - top[1], rel=1e-3)


def test_places_of_a_tail_are_known_in_millimetres(lens: Lens) -> None:
    learned = learn(FILM, lens)
    assert learned.pixels_per_mm == lens.pixels_per_mm
    camera = FilmedTail(FILM)
    tip = camera.midline(np.zeros(1), np.zeros(1))[0, -1] * FILM.length * FILM.width
    root = np.array([FILM.root[0] * FILM.width - 0.5, camera._centre[1]])
    axis = learned.to_axis(camera._project(np.stack([root, root + tip]), -1.0))
    assert np.ptp(axis[:, 0]) / learned.pixels_per_mm == pytest.approx(
        FILM.length / SQUARE * SQUARE_MM, rel=2e-3
    )
    by_length = learned.with_length(100.0).pixels_per_mm
    assert by_length == pytest.approx(axis[1, 0] / 100.0, rel=0.02)


def test_a_tail_is_measured_only_with_the_lens_it_was_learned_with(lens: Lens) -> None:
    learned = learn(FILM, lens)
    learned.check_lens(lens)
    for present in (None, changed(lens, plane=IDENTITY)):
        with pytest.raises(CannotUse, match=r"without this calibration .*, or with another: learn"):
            learned.check_lens(present)


def test_pictures_of_another_size_are_not_learned_with_a_lens(lens: Lens) -> None:
    with pytest.raises(CannotUseLens, match=r"320 × 240 pixels, but the lens was calibrated with"):
        Learner(lens).add(0.0, np.zeros((240, 320), np.uint8))


def test_pictures_that_are_turned_otherwise_are_refused(lens: Lens) -> None:
    lens.check((640, 480), 0)
    with pytest.raises(CannotUseLens, match=r"turned by 180°, but .* turned by 0°: calibrate"):
        lens.check((640, 480), 180)


Pictures = list[NDArray[np.uint8]]


def held_flat(board: FilmedBoard) -> Pictures:
    return list(board.held(slant=0.02))


def few(board: FilmedBoard) -> Pictures:
    return [board.lying() for _ in range(3)]


def on_one_side(board: FilmedBoard) -> Pictures:
    return [
        board.picture(0.05, np.array([-0.2, down, 0.0]), turn(0.3, slant, 0.0))
        for down in (-0.15, 0.0, 0.15)
        for slant in (-0.6, -0.2, 0.2, 0.6)
    ]


def blurred(board: FilmedBoard) -> Pictures:
    return [board.picture(SQUARE, np.zeros(3), np.eye(3), blur=4.0)]


def far(board: FilmedBoard) -> Pictures:
    return [board.picture(0.012, np.zeros(3), np.eye(3))]


def empty(board: FilmedBoard) -> Pictures:
    return [FilmedTail(FILM).picture(0.0)]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (held_flat, "views are too similar: slant the board more, to all sides"),
        (few, rf"view \d of at least {MIN_VIEWS} is taken: show the board at the"),
        (on_one_side, "show the board at the (top |bottom )?right of the picture, and slant it"),
        (blurred, r"\d of 40 corners of the board are seen: it must be near, sharp, evenly lit"),
        (far, r"\d of 40 corners of the board are seen: it must be near"),
        (empty, "0 of 40 corners of the board are seen: it must be near, sharp, evenly lit"),
    ],
)
def test_views_from_which_no_lens_can_be_calibrated_are_named(
    make: Callable[[FilmedBoard], Pictures], message: str
) -> None:
    watch = BoardWatch(0)
    for picture in make(FilmedBoard(FILM)):
        watch.add(None, picture)
    with pytest.raises(CannotLearn, match=message):
        watch.calibrate()


def test_a_bad_view_is_left_out() -> None:
    watch = BoardWatch(0)
    for picture in FilmedBoard(FILM).held():
        watch.add(None, picture)
    good = watch.calibrate()
    shift = np.random.default_rng(0).normal(0.0, 3.0, watch.views[0].points.shape)
    watch.views[0] = watch.views[0]._replace(points=watch.views[0].points + shift)
    mended = watch.calibrate()
    assert mended.views == good.views - 1
    assert mended.focal == pytest.approx(good.focal, rel=2e-3)


def test_corners_that_fit_no_lens_are_refused() -> None:
    watch = BoardWatch(0)
    for picture in FilmedBoard(FILM).held():
        watch.add(None, picture)
    noise = np.random.default_rng(0)
    watch.views = [
        view._replace(points=view.points + noise.normal(0.0, 2.0, view.points.shape))
        for view in watch.views
    ]
    with pytest.raises(CannotLearn, match=r"the corners are \d\.\d px beside those of any lens: "):
        watch.calibrate()


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (
            lambda board: board.picture(0.04, np.zeros(3), np.eye(3)),
            "the board is too small in the picture: print a larger one",
        ),
        (
            lambda board: cv2.warpPerspective(board.lying(), np.eye(3), (640, 240)),
            "the picture has 640 × 240 pixels, but the lens was calibrated with 640 × 480",
        ),
        (
            lambda board: cv2.remap(
                board.lying(),
                *np.float32(np.meshgrid(np.arange(640), np.arange(480)))
                + np.float32([0, 6])[:, None, None]
                * np.sin(np.arange(640) / 60.0).astype(np.float32),
                cv2.INTER_LINEAR,
            ),
            r"the corners are \d\.\d px beside those of a plane: lay the board flat",
        ),
    ],
    ids=["small", "size", "waves"],
)
def test_a_picture_that_shows_no_plane_is_named(
    lens: Lens, picture: Callable[[FilmedBoard], NDArray[np.uint8]], message: str
) -> None:
    watch = BoardWatch(0)
    watch.add(None, picture(FilmedBoard(FILM)))
    with pytest.raises((CannotLearn, CannotUseLens), match=message):
        find_plane(lens, watch, None)


def test_only_a_board_that_is_still_is_taken_from_a_camera() -> None:
    board, watch = FilmedBoard(FILM), BoardWatch(0)
    places = [-0.2, -0.18, -0.18, -0.18, 0.1, 0.1]
    times = [0.0, 0.1, 0.2, 0.3, 0.4, 1.4]
    taken = [
        watch.add(time, board.picture(0.06, np.array([place, 0.0, 0.0]), np.eye(3)))
        for time, place in zip(times, places, strict=True)
    ]
    assert taken == [False, False, True, False, False, False]
    assert watch.problem == "hold the board still"


def test_pictures_of_another_size_are_not_mixed() -> None:
    watch = BoardWatch(0)
    watch.add(None, np.zeros((480, 640), np.uint8))
    with pytest.raises(CannotLearn, match="change from 640 × 480 to 320 × 240 pixels"):
        watch.add(None, np.zeros((240, 320), np.uint8))


def test_the_printed_board_has_its_true_size() -> None:
    svg = draw_svg(30.0)
    size = re.search(r'width="([\d.]+)mm" height="([\d.]+)mm" viewBox="([-\d. ]+)"', svg)
    assert size
    box = [float(value) for value in size[3].split()]
    assert float(size[1]) * draw_board().shape[1] / box[2] == pytest.approx(COLUMNS * 30.0)
    drawn = np.full(draw_board().shape, 255, np.uint8)
    for column, row in re.findall(r"M(\d+) (\d+)h1v1h-1z", svg):
        drawn[int(row), int(column)] = 0
    assert np.array_equal(drawn, draw_board())
    printed = cv2.copyMakeBorder(drawn, 3, 3, 3, 3, cv2.BORDER_CONSTANT, value=255)
    seen = find_board(cv2.resize(printed, None, fx=6, fy=6, interpolation=cv2.INTER_AREA))
    assert not isinstance(seen, str)
    assert len(seen.numbers) == 40
    assert "270 mm" in svg


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content[:-9],
        lambda content: b"\xff\xfe" + content,
        lambda content: b"{}",
        lambda content: re.sub(rb'"focal": \[\s*[\d.]+', b'"focal": [0.0', content),
        lambda content: re.sub(rb'"focal": \[\s*[\d.]+', b'"focal": [1e300', content),
        lambda content: re.sub(
            rb'"plane": \[[^]]*\]', b'"plane": ' + b"[" + 8 * b"0," + b"0]", content
        ),
    ],
    ids=["torn", "no text", "another", "no focal length", "no number of a camera", "no plane"],
)
def test_a_file_that_is_no_calibration_is_refused(
    lens: Lens, tmp_path: Path, change: Callable[[bytes], bytes]
) -> None:
    path = tmp_path / "lens.json"
    lens.save(path)
    assert Lens.load(path) == lens
    before = path.read_bytes()
    path.write_bytes(change(before))
    assert path.read_bytes() != before
    with pytest.raises(CannotUseLens, match=r"lens.json contains no calibration of a lens"):
        Lens.load(path)
