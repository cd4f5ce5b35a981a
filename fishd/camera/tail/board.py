"""Printed board before the camera: its drawing, its corners, and calibration of the lens from them.

The board is a chessboard with markers (ChArUco): each corner has a number, so that a part of the
board is sufficient, and the edge of the picture is calibrated, too.
"""

from datetime import UTC, datetime
from typing import NamedTuple

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.camera.tail.learner import CannotLearn
from fishd.camera.tail.lens import Array, Lens, Turn
from fishd.core.camera_frames import Pixels

COLUMNS, ROWS = 9, 6
"""Number of squares."""
SQUARE_MM = 28.0
"""Default side of a square, with which the board fits on A4 and Letter [mm]."""
MODULES = 8
"""Modules along the side of a square; its marker has 6."""
MIN_VIEWS = 10
"""Fewest different pictures of the board from which a lens is calibrated."""
_MIN_CORNERS = 12
"""Fewest corners of a picture that counts."""
_STILL_PX, _STILL_S = 0.5, 0.6
"""Largest mean motion of the corners from one picture to the next, and longest time between."""
_NEW_VIEW = 0.04
"""Smallest mean motion of the corners to another view, relative to the picture's width."""
_MIN_AREA = 0.08
"""Smallest area of a board in the plane of the tail, relative to the picture's."""
_MAX_ERROR = 0.0015
"""Largest error of the corners, relative to the picture's width."""
_OUTLIER = 2.5
"""Error of a view that is left out, relative to the median."""
_MAX_FOCAL_ERROR = 0.02
"""Largest standard error of the focal length, relative."""
_PLACES = [
    *("top left", "top", "top right"),
    *("left", "middle", "right"),
    *("bottom left", "bottom", "bottom right"),
]

_board = cv2.aruco.CharucoBoard(
    (COLUMNS, ROWS),
    1.0,
    (MODULES - 2) / MODULES,
    cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50),
)
_detector = cv2.aruco.CharucoDetector(_board)
_corners = np.asarray(_board.getChessboardCorners(), np.float64)[:, :2]
"""Places of the inner corners [sides of a square]."""


def draw_board() -> Pixels:
    """Return the board with a pixel for each module."""
    size = COLUMNS * MODULES, ROWS * MODULES
    return np.asarray(_board.generateImage(size, None, 0, 1), np.uint8)


def draw_svg(square_mm: float) -> str:
    """Return the board as SVG in true size."""
    width, height = COLUMNS * MODULES, ROWS * MODULES
    black = "".join(f"M{x} {y}h1v1h-1z" for y, x in np.argwhere(draw_board() == 0).tolist())
    mm, edge = square_mm / MODULES, 2.5
    box = -edge, -edge, width + 2 * edge, height + 2 * edge
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{mm * box[2]:g}mm" '
        f'height="{mm * box[3]:g}mm" viewBox="{" ".join(map(str, box))}">'
        f'<path fill="#fff" d="M{box[0]} {box[1]}h{box[2]}v{box[3]}h-{box[2]}z"/>'
        f'<path d="{black}" shape-rendering="crispEdges"/>'
        f'<text y="{height + 1.8}" font-size="1.5" font-family="sans-serif">fishctl camera lens: '
        f"{COLUMNS} squares are {mm * width:g} mm if printed at 100 %</text></svg>\n"
    )


class View(NamedTuple):
    """Corners of the board in a picture."""

    numbers: NDArray[np.int64]
    """Shape (n,)."""
    points: Array
    """Columns and rows, shape (n, 2) [px]."""

    def distance(self, view: "View") -> float:
        """Return the mean distance of the corners from those of another view [px]."""
        _, here, there = np.intersect1d(self.numbers, view.numbers, return_indices=True)
        apart = self.points[here] - view.points[there]
        return float(np.hypot(*apart.T).mean()) if len(apart) else np.inf


def find_board(picture: Pixels) -> View | str:
    """Return the corners of the board in a picture, or why there are too few."""
    points, numbers, _, _ = _detector.detectBoard(picture)
    count = 0 if numbers is None else len(numbers)
    if count < _MIN_CORNERS:
        all_of = f"{count} of {len(_corners)} corners of the board are seen"
        return f"{all_of}: it must be near, sharp, evenly lit and in the picture"
    return View(numbers.ravel().astype(np.int64), points.reshape(-1, 2).astype(np.float64))


class BoardWatch:
    """Collector of different pictures of the board, from which the lens is calibrated."""

    def __init__(self, rotate: Turn, size: tuple[int, int] | None = None) -> None:
        """
        rotate: clockwise turn of the pictures [degrees]
        size: that of whole pictures, of which smaller ones are added; None: that of the first [px]
        """
        self.rotate, self.size = rotate, size
        self._is_scaled = size is not None
        self._last: tuple[float, View] | None = None
        self.views: list[View] = []
        self.problem = "no picture has come"
        """Why the latest picture was not taken; empty if it was."""

    def add(self, time: float | None, picture: Pixels) -> bool:
        """Add a turned picture; return whether it was taken. Raise `CannotLearn` for another size.

        time: of a picture of a camera or a video, where the board must be still [s]; None for a
            picture by itself
        """
        size = (picture.shape[1], picture.shape[0])
        self.size = self.size or size
        if size != self.size and not self._is_scaled:
            raise CannotLearn(
                f"the pictures change from {self.size[0]} × {self.size[1]} to {size[0]} × "
                f"{size[1]} pixels: calibrate with pictures of one size"
            )
        before, self._last = self._last, None
        view = find_board(picture)
        if isinstance(view, str):
            self.problem = view
            return False
        view = view._replace(points=(view.points + 0.5) * np.divide(self.size, size) - 0.5)
        is_still = time is None
        if time is not None:
            self._last = time, view
            is_next = before is not None and 0.0 < time - before[0] < _STILL_S
            is_still = is_next and before is not None and view.distance(before[1]) < _STILL_PX
        near = min(map(view.distance, self.views), default=np.inf) < _NEW_VIEW * self.size[0]
        self.problem = "this view was taken: move the board" if near else ""
        if not is_still:
            self.problem = "hold the board still"
        if not self.problem:
            self.views.append(view)
        return not self.problem

    def calibrate(self) -> Lens:
        """Return the lens; raise `CannotLearn` with what the board has to show for that."""
        if not self.views or self.size is None:
            raise CannotLearn(self.problem)
        places = np.concatenate([view.points for view in self.views]) * 3.0 / self.size
        column, row = np.clip(places.astype(int), 0, 2).T
        counts = np.bincount(3 * row + column, minlength=9)
        if counts.min() < _MIN_CORNERS // 2 or len(self.views) < MIN_VIEWS:
            place = _PLACES[int(counts.argmin())]
            raise CannotLearn(
                f"view {len(self.views)} of at least {MIN_VIEWS} is taken: show the board at the "
                f"{place} of the picture, and slant it"
            )
        views, errors = self.views, np.empty(0)
        for _ in range(2):  # the second time without the views that fit worst
            error, matrix, radial, spread, errors = _calibrate(views, self.size)
            used = errors <= _OUTLIER * np.median(errors)
            views = [view for view, is_used in zip(views, used, strict=True) if is_used]
        _check_error(error, self.size[0], "any lens", "take sharp pictures, with a usual lens")
        if not spread[:2].max() < _MAX_FOCAL_ERROR * matrix[0, 0]:
            raise CannotLearn(
                f"the {len(errors)} views are too similar: slant the board more, to all sides"
            )
        return Lens(
            date=_now(),
            size=self.size,
            rotate=self.rotate,
            views=len(errors),
            error=error,
            focal=(float(matrix[0, 0]), float(matrix[1, 1])),
            centre=(float(matrix[0, 2]), float(matrix[1, 2])),
            distortion=(float(radial[0]), float(radial[1])),
        )


def find_plane(lens: Lens, watch: BoardWatch, square_mm: float | None) -> Lens:
    """Return the lens with the plane of the tail, in which the board of the latest view lies.

    square_mm: side of a square [mm]; None if it is unknown
    Raise `CannotLearn` and `CannotUseLens`.
    """
    if not watch.views or watch.size is None:
        raise CannotLearn(watch.problem)
    (width, height), view = watch.size, watch.views[-1]
    lens.check(watch.size, watch.rotate)
    area = cv2.contourArea(cv2.convexHull(view.points.astype(np.float32)))
    if area < _MIN_AREA * width * height:
        raise CannotLearn("the board is too small in the picture: print a larger one")
    squares = _corners[view.numbers]
    straight = lens.straighten(view.points[:, None])[:, 0]
    matrix, _ = cv2.findHomography(straight, squares)
    there = cv2.perspectiveTransform(squares[:, None], np.linalg.inv(matrix))[:, 0]
    error = float(np.sqrt(np.mean(np.sum((there - straight) ** 2, axis=1))))
    _check_error(error, width, "a plane", "lay the board flat, without waves above it")
    # In the middle of the picture, the plane's pixels have its scale and its directions.
    middle = 0.5 * (np.array([width, height]) - 1.0)
    near = lens.straighten(np.add(middle, [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])[:, None])
    place, right, down = cv2.perspectiveTransform(near, matrix)[:, 0]
    u, sizes, v = np.linalg.svd(np.stack([right - place, down - place], axis=1))
    scale = float(np.sqrt(sizes.prod()))
    even = np.eye(3)
    even[:2, :2] = (u @ v).T / scale
    even[:2, 2] = middle - even[:2, :2] @ place
    return replace(
        lens,
        date=_now(),
        plane=tuple((even @ matrix).ravel().tolist()),
        plane_error=error,
        pixels_per_mm=1.0 / (scale * square_mm) if square_mm else None,
    )


def _calibrate(
    views: list[View], size: tuple[int, int]
) -> tuple[float, Array, Array, Array, Array]:
    """Return error [px], camera matrix, distortion, their standard errors, and errors of views."""
    boards = [np.pad(_corners[view.numbers], ((0, 0), (0, 1))).astype(np.float32) for view in views]
    points = [view.points.astype(np.float32) for view in views]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    try:
        error, matrix, radial, _, _, spread, _, errors = cv2.calibrateCameraExtended(
            boards, points, size, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error:
        raise CannotLearn("the views are too similar: slant the board more, to all sides") from None
    arrays = (np.asarray(each, np.float64) for each in (matrix, radial, spread, errors))
    matrix, radial, spread, errors = arrays
    return float(error), matrix, radial.ravel(), spread.ravel(), errors.ravel()


def _check_error(error: float, width: int, model: str, remedy: str) -> None:
    """Raise `CannotLearn` for an error that is too large for the picture's width [px]."""
    if error > _MAX_ERROR * width:
        raise CannotLearn(f"the corners are {error:.1f} px beside those of {model}: {remedy}")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
