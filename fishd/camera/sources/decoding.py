"""Decoding of V4L2 pixel formats MJPG, YUYV and GREY to grey levels."""

import numpy as np
import simplejpeg

from fishd.core.camera_frames import Pixels


class Broken(ValueError):
    """A frame cannot be decoded."""


def decode_grey(data: bytes, fourcc: str, width: int, height: int, line: int) -> Pixels:
    """Return the picture, shape (height, width); raises `Broken`.

    fourcc: MJPG, YUYV or GREY; line: bytes per line of an uncompressed format
    """
    if fourcc == "MJPG":
        picture = _decode_jpeg(data)
        if picture.shape != (height, width):
            raise Broken(f"the picture has {picture.shape[1]} x {picture.shape[0]} px")
        return picture
    step = 2 if fourcc == "YUYV" else 1
    line = max(line, step * width)
    if len(data) < line * (height - 1) + step * width:
        raise Broken(f"the frame has only {len(data)} bytes")
    lines = np.zeros(height * line, np.uint8)
    received = np.frombuffer(data, np.uint8)[: height * line]
    lines[: len(received)] = received
    return np.ascontiguousarray(lines.reshape(height, line)[:, : step * width : step])


def _decode_jpeg(data: bytes) -> Pixels:
    try:
        pixels = _run_decoder(data, strict=True)
    except ValueError as error:
        if "extraneous" not in str(error).lower():  # harmless, and many cameras send such bytes
            raise Broken(str(error)) from None
        pixels = _run_decoder(data, strict=False)
    return pixels


def _run_decoder(data: bytes, *, strict: bool) -> Pixels:
    pixels = simplejpeg.decode_jpeg(
        data, colorspace="GRAY", fastdct=True, fastupsample=True, strict=strict
    )
    return np.asarray(pixels, np.uint8)[:, :, 0]
