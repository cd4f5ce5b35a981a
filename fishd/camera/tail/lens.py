"""Calibration of the camera's lens and of its view of the plane of the tail, and its file."""

from pathlib import Path
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fishd.core import files, text
from fishd.core.errors import FishdError
from fishd.core.schema import note, unit

Array = NDArray[np.float64]
MAX_VALUE = 1e9
"""Largest number of a lens: far beyond those of cameras, far below where computing fails."""
_MAX_BYTES = 2**16
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-7)
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
Turn = Literal[0, 90, 180, 270]
"""Clockwise rotation of a picture [degrees]."""


class CannotUseLens(FishdError, ValueError):
    """A calibration cannot be read or written, or is not that of these pictures."""


class Lens(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Lens of turned whole pictures; distortion is radial, as OpenCV defines it."""

    date: Annotated[str, note("Date and time of calibration, ISO 8601.")]
    size: Annotated[tuple[int, int], unit("px", "Width and height of the pictures.")]
    rotate: Annotated[Turn, note("Clockwise rotation of the pictures [degrees].")]
    views: Annotated[int, note("Number of pictures of the board.")]
    error: Annotated[float, unit("px", "Error of the corners in them, root mean square.", ge=0)]
    focal: Annotated[tuple[float, float], unit("px", "Focal length along rows and columns.")]
    centre: Annotated[tuple[float, float], unit("px", "Column and row of the optical axis.")]
    distortion: Annotated[tuple[float, float], note("Radial distortion: k₁ and k₂.")]
    plane: Annotated[
        tuple[float, ...],
        note(
            "Map from a picture without distortion to the plane of the tail, row by row [px].",
            min_length=9,
            max_length=9,
        ),
    ] = _IDENTITY
    plane_error: Annotated[
        float | None, unit("px", "Error of the corners in that plane; null: it is not calibrated.")
    ] = None
    pixels_per_mm: Annotated[
        float | None, unit("px/mm", "Scale in that plane; null if it is unknown.")
    ] = None

    def __post_init__(self) -> None:
        """Raise ValueError for values that no camera has."""
        if min(*self.size, *self.focal) < 1.0:
            raise ValueError("size and focal length must be at least a pixel")
        values = *self.size, *self.focal, *self.centre, *self.distortion, *self.plane
        if max(map(abs, values)) > MAX_VALUE:
            raise ValueError(f"the numbers of a lens are not beyond {MAX_VALUE:g}")
        if np.linalg.det(np.reshape(self.plane, (3, 3))) <= 0.0:
            raise ValueError("the map to the plane must not turn it over")

    def to_plane(self, points: Array, factor: float = 1.0) -> Array:
        """Return where points of a picture lie in the plane of the tail, shape (…, 2) [px].

        A pixel of the plane has the size of one in the middle of the picture.

        factor: width of the picture that was calibrated, in widths of the picture
        """
        whole = (np.reshape(points, (-1, 1, 2)) + 0.5) * factor - 0.5
        straight = self.straighten(whole, self.plane)
        return np.asarray((straight.reshape(np.shape(points)) + 0.5) / factor - 0.5)

    def straighten(self, points: Array, matrix: tuple[float, ...] = _IDENTITY) -> Array:
        """Return points (n, 1, 2) [px] of a picture without distortion, by a projective map."""
        (fx, fy), (cx, cy) = self.focal, self.centre
        camera = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        # An optical axis in the middle, and square pixels.
        mean = (fx * fy) ** 0.5
        even = np.array([[mean, 0.0, cx], [0.0, mean, cy], [0.0, 0.0, 1.0]])
        turn = np.reshape(matrix, (3, 3)) @ even
        radial = np.array([*self.distortion, 0.0, 0.0])
        return np.asarray(cv2.undistortPoints(points, camera, radial, R=turn, criteria=_CRITERIA))

    def check(self, size: tuple[int, int], rotate: int) -> None:
        """Raise `CannotUseLens` for pictures of another size [px] or rotation [degrees]."""
        if size != self.size:
            raise CannotUseLens(
                f"the picture has {size[0]} × {size[1]} pixels, but the lens was calibrated with "
                f"{self.size[0]} × {self.size[1]}: calibrate it again"
            )
        if rotate != self.rotate:
            raise CannotUseLens(
                f"the picture is turned by {rotate}°, but the lens was calibrated with pictures "
                f"turned by {self.rotate}°: calibrate it again"
            )

    def describe(self) -> str:
        """Return its date and errors in one line."""
        error = self.plane_error
        plane = "" if error is None else f", plane of the tail {error:.2f} px"
        return f"calibrated {self.date}, error {self.error:.2f} px{plane}"

    def save(self, path: Path, *, new: bool = False) -> None:
        """Write the file, as one that does not exist yet if it is new; raise `CannotUseLens`."""
        try:
            files.write_atomically(path, msgspec.json.format(msgspec.json.encode(self)), new=new)
        except OSError as error:
            raise CannotUseLens(f"{path} cannot be written: {error.strerror or error}") from None

    @classmethod
    def load(cls, path: Path) -> "Lens":
        """Return what a file contains; raise `CannotUseLens`."""
        shown = text.quoted(str(path))
        try:
            return msgspec.json.decode(files.read(path, _MAX_BYTES, "a lens"), type=cls)
        except files.FileProblem as problem:
            raise CannotUseLens(f"{shown}: {problem}") from None
        except (msgspec.DecodeError, UnicodeError):
            raise CannotUseLens(
                f"{shown} contains no calibration of a lens: calibrate again"
            ) from None
