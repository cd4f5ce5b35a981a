"""Result of learning the tail, the ground and the camera, and its file."""

import re
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.camera.tail.lens import Lens
from fishd.camera.tail.profile import STATIONS, Array, Pose
from fishd.core import files, text
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError
from fishd.core.schema import note, unit

_HEAD = b"fishd tail %d\n"
_VERSION = 2
_MAX_BYTES = 4 * 2**20
ORDER = 4
"""Number of powers of α, from 0, in the description of the midline."""

PerStation = Annotated[tuple[float, ...], Meta(min_length=STATIONS, max_length=STATIONS)]


def find_stations(fin: tuple[float, float]) -> slice:
    """Return the stations between two fractions of the tail's length from its tip."""
    return slice(round((1.0 - fin[1]) * STATIONS), round((1.0 - fin[0]) * STATIONS))


class CannotUse(FishdError, ValueError):
    """A file of a learned tail cannot be read, or does not fit the pictures."""


class Learned(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Tail, ground and camera; lengths are in pixels of the turned whole picture.

    Angles, `shape` and its errors, and `pixels_per_mm` belong to the plane of the tail.
    """

    date: Annotated[str, note("Date and time of learning, ISO 8601.")]
    size: Annotated[tuple[int, int], unit("px", "Width and height of the picture.")]
    background_size: Annotated[tuple[int, int], unit("px", "Width and height of `background`.")]
    background: Annotated[bytes, note("Grey levels of the picture without the tail, row by row.")]
    swept: Annotated[bytes, note("1 bit for each pixel of `background`: where the tail can be.")]
    tail_level: Annotated[float, unit("1", "Grey level of the tail.", ge=0, le=255)]
    root: Annotated[tuple[float, float], unit("px", "Column and row of the root of the tail.")]
    direction: Annotated[
        float, unit("rad", "Direction of the fish's axis against the rows, down to the right.")
    ]
    zero: Annotated[float, unit("rad", "Direction of the fin at rest against that axis.")]
    zero_ci95: Annotated[
        float,
        unit("rad", "Half-width of the 95 % interval of `zero`; larger if it never rested.", ge=0),
    ]
    span: Annotated[
        tuple[float, float], unit("rad", "Smallest and largest fin angle during learning.")
    ]
    top_rate: Annotated[float, unit("rad/s", "Highest speed of the fin during learning.", ge=0)]
    length: Annotated[float, unit("px", "Length of the tail from the root.", gt=0)]
    half_thickness: Annotated[PerStation, unit("px", "Half of the thickness, from root to tip.")]
    fin: Annotated[
        tuple[float, float],
        note("Where the straight part begins and ends: fractions of the length from the tip."),
    ]
    shape: Annotated[
        tuple[tuple[PerStation, PerStation], ...],
        note(
            "Midline: coefficients of the powers of α, of the places along and across the axis.",
            min_length=ORDER,
            max_length=ORDER,
        ),
    ]
    shape_error: Annotated[
        float, unit("px", "95 % of the pictures lay closer to `shape`, root mean square.", ge=0)
    ]
    direction_error: Annotated[
        float, unit("rad", "95 % of the fins were closer to the direction by `shape`.", ge=0)
    ]
    turn_error: Annotated[
        float, unit("rad", "95 % of the midlines were turned less against `shape`.", ge=0)
    ]
    covariance: Annotated[
        tuple[PerStation, ...],
        note(
            "Covariance of the distances from `shape` [px²].",
            min_length=STATIONS,
            max_length=STATIONS,
        ),
    ]
    pose_error: Annotated[
        tuple[float, float, float],
        note("95 % of the pictures were shifted less, along rows and down [px], and turned [rad]."),
    ]
    pixels_per_mm: Annotated[
        float | None, unit("px/mm", "Scale at the depth of the tail; null if unknown.")
    ] = None
    lens: Annotated[
        Lens | None, note("Calibration with which it was learned; null without one.")
    ] = None

    def background_picture(self) -> Pixels:
        """Return the picture without the tail, shape (height, width) of `background_size`."""
        width, height = self.background_size
        return np.frombuffer(self.background, np.uint8).reshape(height, width)

    def swept_mask(self) -> NDArray[np.bool_]:
        """Return where the tail can be, of the same shape."""
        width, height = self.background_size
        bits = np.unpackbits(np.frombuffer(self.swept, np.uint8), count=width * height)
        return np.asarray(bits.reshape(height, width) > 0)

    def with_length(self, length_mm: float | None) -> "Learned":
        """Return this with the scale for a length of the tail [mm]; unchanged for None."""
        if not length_mm:
            return self
        steps = np.diff(np.array(self.shape[0]), axis=1)  # at α = 0
        length = float(np.hypot(*steps).sum()) * STATIONS / (STATIONS - 1)
        return replace(self, pixels_per_mm=length / length_mm)

    def to_axis(self, places: Array) -> Array:
        """Return coordinates along and across the axis, in the plane of the tail [px].

        places: columns and rows of a picture, shape (…, 2) [px]
        """
        pose = Pose(self.root, self.direction)
        if self.lens is None:
            return pose.to_axis(places)
        return pose.in_plane(self.lens).to_axis(self.lens.to_plane(places))

    def check_lens(self, lens: Lens | None) -> None:
        """Raise `CannotUse` if the tail was learned with another calibration, or without one."""
        if self.lens != lens:
            raise CannotUse(
                "the tail was learned without this calibration of the lens, or with another: learn "
                "again"
            )

    def check_size(self, width: int, height: int) -> None:
        """Raise `CannotUse` for pictures of another size."""
        if (width, height) != self.size:
            raise CannotUse(
                f"the picture has {width} × {height} pixels, but the tail was learned from "
                f"{self.size[0]} × {self.size[1]}: learn again"
            )

    def save(self, path: Path) -> None:
        """Write the file; raise `CannotUse`."""
        try:
            files.write_atomically(path, _HEAD % _VERSION + msgspec.msgpack.encode(self))
        except OSError as error:
            raise CannotUse(f"{path} cannot be written: {error.strerror or error}") from None

    @classmethod
    def load(cls, path: Path) -> "Learned":
        """Return what a file contains; raise `CannotUse`."""
        shown = text.quoted(str(path))
        try:
            content = files.read(path, _MAX_BYTES, "a learned tail")
        except files.FileProblem as problem:
            raise CannotUse(f"{shown}: {problem}") from None
        head = re.match(rb"fishd tail (\d{1,9})\n", content)
        if head is None:
            raise CannotUse(f"{shown} contains no learned tail")
        if int(head[1]) != _VERSION:
            raise CannotUse(
                f"{shown} was written by another version of fishd (format {int(head[1])}, here "
                f"{_VERSION}): learn again"
            )
        try:
            learned = msgspec.msgpack.decode(content[head.end() :], type=cls)
            learned._check()
        except (msgspec.DecodeError, ValueError):
            raise CannotUse(f"{shown} is damaged: learn again") from None
        return learned

    def _check(self) -> None:
        """Raise ValueError where fields contradict one another."""
        width, height = self.background_size
        sizes = min(width, height) > 0 and width <= self.size[0] and height <= self.size[1]
        if not sizes or len(self.background) != width * height:
            raise ValueError("size")
        if len(self.swept) != (width * height + 7) // 8:
            raise ValueError("swept")
        first, last = self.fin
        if not 0.0 <= first < last <= 1.0 or not self.span[0] < self.span[1]:
            raise ValueError("fin or span")
