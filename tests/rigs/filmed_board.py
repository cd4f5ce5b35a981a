"""Pictures of a printed board through the camera of a film."""

import math
from collections.abc import Iterator
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fishd.camera.tail.board import COLUMNS, MODULES, ROWS, BoardWatch, draw_board, find_plane
from fishd.camera.tail.lens import Lens
from rigs.filmed_tail import Film, Floats

_FINE = 8
"""Pixels of the drawn board along a module."""
_SAMPLES = 3
"""Samples per pixel along both directions."""
_MARGIN = 2
"""White modules around it."""
SQUARE_MM = 25.0


class FilmedBoard:
    """Camera of a film that sees a board instead of a tail."""

    def __init__(self, film: Film) -> None:
        self.film = film
        self._random = np.random.default_rng(film.seed + 7)
        self._centre = 0.5 * (np.array([film.width, film.height]) - 1.0)
        drawn = cv2.copyMakeBorder(
            draw_board(),
            *[_MARGIN] * 4,
            cv2.BORDER_CONSTANT,
            value=255,  # type: ignore[arg-type]
        )
        self._board = cv2.resize(drawn, None, fx=_FINE, fy=_FINE, interpolation=cv2.INTER_NEAREST)
        self._straight = self._straighten()

    def _straighten(self) -> Floats:
        """Return where each pixel is seen by an ideal camera, from its centre."""
        film = self.film
        pixels = np.meshgrid(np.arange(film.width), np.arange(film.height))
        seen = (np.stack(pixels, axis=2) - self._centre) * (1.0, film.aspect)
        ideal = seen
        for _ in range(20):
            radius = np.linalg.norm(ideal, axis=2, keepdims=True) / math.hypot(*self._centre)
            ideal = seen / (1.0 + film.lens * radius**2)
        return ideal

    def picture(
        self, square: float, place: Floats, rotation: Floats, blur: float = 0.0
    ) -> NDArray[np.uint8]:
        """Return a picture of the board.

        square: side of a square; place: of its middle, from that of the plane of the tail; as
            fractions of the width
        rotation: matrix from the axes of the board to those of the camera
        blur: standard deviation [px]
        """
        film, width = self.film, float(self.film.width)
        # Sides of a square and corner of the board, in the axes of the camera, in widths.
        sides = square * rotation[:, :2]
        corner = np.asarray(place) + np.array([0.0, 0.0, 1.0]) - sides @ (COLUMNS / 2, ROWS / 2)
        to_picture = np.diag([width, width, 1.0]) @ np.column_stack([sides, corner])
        straight = self._straight.reshape(-1, 1, 2)
        board = cv2.perspectiveTransform(straight, np.linalg.inv(to_picture))
        places = ((board * MODULES + _MARGIN) * _FINE - 0.5).astype(np.float32)
        samples = cv2.resize(places.reshape(self._straight.shape), None, fx=_SAMPLES, fy=_SAMPLES)
        fine = cv2.remap(
            self._board, samples, None, cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT, borderValue=film.water,
        )  # fmt: skip
        picture = cv2.resize(fine, (film.width, film.height), interpolation=cv2.INTER_AREA)
        if blur:
            picture = cv2.GaussianBlur(picture, (0, 0), blur)
        picture = 30.0 + 0.7 * picture + film.noise * self._random.standard_normal(picture.shape)
        return np.clip(picture + 0.5, 0.0, 255.0).astype(np.uint8)

    def lying(self, square: float = 0.08) -> NDArray[np.uint8]:
        """Return a picture of the board in the plane of the tail."""
        spin = turn(0.0, 0.0, self._random.uniform(-0.3, 0.3))
        return self.picture(square, (0.0, 0.0, 0.0), turn(0.0, -self.film.tilt, 0.0) @ spin)

    def held(self, count: int = 15, slant: float = 0.5) -> Iterator[NDArray[np.uint8]]:
        """Yield pictures of the board in all parts of the picture, slanted to all sides."""
        draw, ratio = self._random.uniform, self.film.height / self.film.width
        for number in range(count):
            column, row = number % 3 - 1, number // 3 % 3 - 1
            place = np.array([0.3 * column, 0.3 * ratio * row, 0.0]) + draw(-0.05, 0.05, 3)
            yield self.picture(0.06, place, turn(*draw(-slant, slant, 3)))


def turn(about_x: float, about_y: float, about_z: float) -> Floats:
    """Return the matrix of turns about the columns' axis, the rows' and the optical one [rad]."""
    x, y, z = (
        cv2.Rodrigues(angle * axis)[0]
        for angle, axis in zip((about_x, about_y, about_z), np.eye(3), strict=True)
    )
    return np.asarray(x @ y @ z)


@cache
def calibrate(film: Film) -> Lens:
    """Return the calibration of a film's camera, from pictures of a board."""
    board = FilmedBoard(film)
    views = BoardWatch(0)
    for picture in board.held():
        views.add(None, picture)
    plane = BoardWatch(0)
    plane.add(None, board.lying())
    return find_plane(views.calibrate(), plane, SQUARE_MM)
