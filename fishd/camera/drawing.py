"""Pictures for people: frames and motion in colours, the axis drawn in, as PNG."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import Axis, Floats
from fishd.camera.messages import Crop, PublishedView
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError
from fishd.core.files import write_atomically

Colours = NDArray[np.uint8]
"""Red, green and blue, shape (height, width, 3)."""

AXIS = (255, 90, 60)
"""Colour of the axis."""
CROP = (90, 200, 255)
"""Colour of the edge of what frames show."""
_LARGE = 640
"""A frame is enlarged to about so many pixels for a file."""


def coloured(pixels: Pixels) -> Colours:
    """Grey levels as colours."""
    return np.repeat(pixels[:, :, np.newaxis], 3, axis=2)


def motion_colours(energy: Floats) -> Colours:
    """A picture of motion: dark where nothing moves, yellow where most does."""
    strength = np.sqrt(energy / max(float(np.quantile(energy, 0.995)), 1e-12))
    levels = np.asarray(np.clip(255.0 * strength, 0.0, 255.0), np.uint8)
    return _swapped(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO))


def enlarged(colours: Colours) -> Colours:
    """The same with larger pixels."""
    factor = max(1, _LARGE // max(colours.shape[:2]))
    return np.asarray(colours.repeat(factor, axis=0).repeat(factor, axis=1))


def with_axis(colours: Colours, axis: Axis | None, size: int, crop: Crop | None = None) -> Colours:
    """The same with an axis drawn in.

    axis: in frames of `size` rows and columns; None draws nothing
    crop: where in the picture frames are cut from; None where it shows what they show
    """
    drawn = np.ascontiguousarray(colours)
    height, width = drawn.shape[:2]
    crop = crop or Crop(left=0.0, top=0.0, width=1.0, height=1.0)

    def point(column: float, row: float) -> tuple[int, int]:
        x = (crop.left + (column + 0.5) / size * crop.width) * width - 0.5
        y = (crop.top + (row + 0.5) / size * crop.height) * height - 0.5
        return round(x), round(y)

    if (crop.width, crop.height) != (1.0, 1.0):
        corner, other = point(-0.5, -0.5), point(size - 0.5, size - 0.5)
        cv2.rectangle(drawn, corner, other, CROP, 1)
    if axis is not None:
        rows = axis.rows(size, size)
        ends = point(0.0, float(rows[0])), point(size - 1.0, float(rows[-1]))
        thickness = max(1, min(height, width) // 240)
        cv2.line(drawn, *ends, AXIS, thickness, cv2.LINE_AA if thickness > 1 else cv2.LINE_8)
    return drawn


def whole_picture(view: PublishedView) -> Colours:
    """The camera's whole picture; raises `FishdError` where it is no picture."""
    grey = cv2.imdecode(np.frombuffer(view.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise FishdError("what the camera sends as its view is no JPEG picture")
    return coloured(np.asarray(grey, np.uint8))


def write_png(path: Path, colours: Colours) -> None:
    """Write a picture; raises `FishdError`."""
    _, data = cv2.imencode(".png", _swapped(colours))
    try:
        write_atomically(path, data.tobytes())
    except OSError as error:
        raise FishdError(f"{path} cannot be written: {error.strerror or error}") from None


def _swapped(colours: object) -> Colours:
    """Between the order of OpenCV, blue first, and that of everybody else."""
    return np.ascontiguousarray(np.asarray(colours, np.uint8)[:, :, ::-1])
