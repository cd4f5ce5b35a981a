"""Conversion of a camera's picture to the frame for learners and the view for people."""

from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from fishd.camera.messages import Crop
from fishd.camera.settings import PictureSettings, PublishSettings
from fishd.core.camera_frames import Pixels

_TURNS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


def read_picture(path: Path) -> "Pixels | None":
    """Return the grey levels of the picture in a file; None if it contains none."""
    picture = None
    with suppress(cv2.error):  # it is too large
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
    return None if picture is None else np.asarray(picture, np.uint8)


def rotate(picture: Pixels, turn: int) -> Pixels:
    """Return the picture turned clockwise by 0, 90, 180 or 270 [degrees]."""
    return np.asarray(cv2.rotate(picture, _TURNS[turn]), np.uint8) if turn else picture


def turn_read_out(read_out: float, turn: int) -> tuple[float, float]:
    """Return the time from the exposure of the first row of a turned picture to that of the last.

    The second value is the same for the columns, of a picture that was turned by 90° [s].
    read_out: of the picture before it was turned [s]
    turn: clockwise turn [degrees]
    """
    return (
        {0: read_out, 180: -read_out}.get(turn, 0.0),
        {90: -read_out, 270: read_out}.get(turn, 0.0),
    )


def crop(picture: Pixels, settings: PictureSettings) -> tuple[Pixels, Crop]:
    """Return the square of a turned picture that frames show, and its place."""
    height, width = picture.shape
    side = max(1, round(settings.crop.side * min(height, width)))
    left = min(max(0, round(settings.crop.x * width - 0.5 * side)), width - side)
    top = min(max(0, round(settings.crop.y * height - 0.5 * side)), height - side)
    place = Crop(left=left / width, top=top / height, width=side / width, height=side / height)
    return picture[top : top + side, left : left + side], place


def make_frame(picture: Pixels, settings: PictureSettings) -> Pixels:
    """Return the frame for learners from a turned picture, shape (size, size)."""
    part, _ = crop(picture, settings)
    return resize(part, settings.size, settings.size)


def resize(picture: Pixels, width: int, height: int) -> Pixels:
    """Return the picture in another size [px]: averaged over areas, or with larger pixels."""
    if picture.shape[:2] == (height, width):
        return picture
    smaller = width <= picture.shape[1] and height <= picture.shape[0]
    interpolation = cv2.INTER_AREA if smaller else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(picture, (width, height), interpolation=interpolation), np.uint8)


def encode_jpeg(picture: Pixels, settings: PublishSettings) -> tuple[bytes, int, int]:
    """Return a turned picture as JPEG for people, and its width and height [px]."""
    height, width = picture.shape
    scale = settings.view_width / width
    if scale > 1.0:  # larger pixels, in whole steps
        scale = float(int(scale))
    shown = resize(picture, max(1, round(width * scale)), max(1, round(height * scale)))
    grey = np.ascontiguousarray(shown)[:, :, np.newaxis]
    data: bytes = simplejpeg.encode_jpeg(grey, settings.view_quality, colorspace="GRAY")
    return data, shown.shape[1], shown.shape[0]
