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


def draw_axis(colours: Colours, axis: Axis, size: int) -> Colours:
    """Return an enlarged frame of `size` rows and columns with its axis drawn in."""
    scale = len(colours) / size
    left, right = (round((column + 0.5) * scale - 0.5) for column in (0, size - 1))
    rows = axis.rows(size, size)
    first, last = (round((float(row) + 0.5) * scale - 0.5) for row in (rows[0], rows[-1]))
    thickness = max(1, len(colours) // 240)
    style = cv2.LINE_AA if thickness > 1 else cv2.LINE_8
    drawn = cv2.line(colours.copy(), (left, first), (right, last), AXIS_COLOUR, thickness, style)
    return np.asarray(drawn, np.uint8)


def draw_crop(colours: Colours, crop: Crop) -> Colours:
    """Return the camera's whole picture with the outline of the part that frames show."""
    if (crop.width, crop.height) == (1.0, 1.0):
        return colours
    height, width = colours.shape[:2]
    left, right = (round(x * width - 0.5) for x in (crop.left, crop.left + crop.width))
    top, bottom = (round(y * height - 0.5) for y in (crop.top, crop.top + crop.height))
    outlined = cv2.rectangle(colours.copy(), (left, top), (right, bottom), CROP_COLOUR, 1)
    return np.asarray(outlined, np.uint8)


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
