"""From what a camera sends to grey levels: MJPEG, YUYV and grey as V4L2 names them."""

import numpy as np
import simplejpeg

from fishd.core.camera_frames import Pixels


class Broken(ValueError):
    """A frame cannot be decoded."""


def grey(data: bytes, fourcc: str, width: int, height: int, line: int) -> Pixels:
    """The picture, shape (height, width); raises `Broken`.

    fourcc: MJPG, YUYV or GREY; line: bytes per line of an uncompressed format
    """
    if fourcc == "MJPG":
        picture = _jpeg(data)
        if picture.shape != (height, width):
            raise Broken(f"{picture.shape[1]} x {picture.shape[0]} px came")
        return picture
    step = 2 if fourcc == "YUYV" else 1
    line = max(line, step * width)
    if len(data) < line * (height - 1) + step * width:
        raise Broken(f"{len(data)} bytes came")
    lines = np.zeros(height * line, np.uint8)
    found = np.frombuffer(data, np.uint8)[: height * line]
    lines[: len(found)] = found
    return np.ascontiguousarray(lines.reshape(height, line)[:, : step * width : step])


def _jpeg(data: bytes) -> Pixels:
    try:
        found = _decoded(data, strict=True)
    except ValueError as error:
        if "extraneous" not in str(error).lower():  # harmless, and many cameras send such bytes
            raise Broken(str(error)) from None
        found = _decoded(data, strict=False)
    return found


def _decoded(data: bytes, *, strict: bool) -> Pixels:
    found = simplejpeg.decode_jpeg(
        data, colorspace="GRAY", fastdct=True, fastupsample=True, strict=strict
    )
    return np.asarray(found, np.uint8)[:, :, 0]
