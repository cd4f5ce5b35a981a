"""Pictures for people as PNG: frames and motion in colours, with the axis drawn in."""

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
"""Red, green and blue of each pixel, shape (height, width, 3)."""

AXIS_COLOUR = (255, 90, 60)
"""Colour of the axis."""
CROP_COLOUR = (90, 200, 255)
"""Colour of the outline of the part that frames show."""
_ENLARGED_SIZE_PX = 640
"""Approximate width or height to which a frame is enlarged for a file [px]."""


def to_colours(pixels: Pixels) -> Colours:
    """Return grey levels as colours."""
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB), np.uint8)


def draw_motion(energy: Floats) -> Colours:
    """Return a picture of motion, from black where nothing moves to yellow where most moves."""
    strength = np.sqrt(energy / max(float(np.quantile(energy, 0.995)), 1e-12))
    levels = np.asarray(np.clip(255.0 * strength, 0.0, 255.0), np.uint8)
    coloured = cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)
    return np.asarray(cv2.cvtColor(coloured, cv2.COLOR_BGR2RGB), np.uint8)


def enlarge(colours: Colours) -> Colours:
    """Return the picture with larger pixels."""
    factor = max(1, _ENLARGED_SIZE_PX // max(colours.shape[:2]))
    return np.asarray(colours.repeat(factor, axis=0).repeat(factor, axis=1))


def draw_axis(colours: Colours, axis: Axis | None, size: int, crop: Crop | None = None) -> Colours:
    """Return the picture with an axis drawn in.

    axis: axis in frames of `size` rows and columns; None draws nothing
    crop: part of the picture that frames show; None where the picture shows the same part
    """
    drawn = np.ascontiguousarray(colours)
    height, width = drawn.shape[:2]
    crop = crop or Crop(left=0.0, top=0.0, width=1.0, height=1.0)

    def point(column: float, row: float) -> tuple[int, int]:
        x = (crop.left + (column + 0.5) / size * crop.width) * width - 0.5
        y = (crop.top + (row + 0.5) / size * crop.height) * height - 0.5
        return round(x), round(y)

    if (crop.width, crop.height) != (1.0, 1.0):
        corner, opposite_corner = point(-0.5, -0.5), point(size - 0.5, size - 0.5)
        cv2.rectangle(drawn, corner, opposite_corner, CROP_COLOUR, 1)
    if axis is not None:
        rows = axis.rows(size, size)
        ends = point(0.0, float(rows[0])), point(size - 1.0, float(rows[-1]))
        thickness = max(1, min(height, width) // 240)
        cv2.line(drawn, *ends, AXIS_COLOUR, thickness, cv2.LINE_AA if thickness > 1 else cv2.LINE_8)
    return drawn


def decode_view(view: PublishedView) -> Colours:
    """Return the camera's whole picture; raises `FishdError` where it cannot be decoded."""
    grey = cv2.imdecode(np.frombuffer(view.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise FishdError("the view that the camera sends is not a JPEG picture")
    return to_colours(np.asarray(grey, np.uint8))


def write_png(path: Path, colours: Colours) -> None:
    """Write a picture; raises `FishdError`."""
    _, data = cv2.imencode(".png", cv2.cvtColor(colours, cv2.COLOR_RGB2BGR))
    try:
        write_atomically(path, data.tobytes())
    except OSError as error:
        raise FishdError(f"{path} cannot be written: {error.strerror or error}") from None
