"""Frames of a camera in a recording: PNG in the message that Foxglove and Lichtblick show.

The schema is foxglove.CompressedImage, as JSON; beside its fields stand those of fishd, which
viewers pass over. PNG loses nothing, so that what was recorded can be learned from.
"""

import struct
import zlib
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, Struct, structs
from numpy.typing import NDArray

from fishd.core.decoding import decoder
from fishd.core.errors import MissingPackage, RecordingError
from fishd.core.schema import fields_of, note, unit

TOPIC = "camera"
SCHEMA = "foxglove.CompressedImage"
_TYPES = {"number": "number", "integer": "integer", "text": "string", "boolean": "boolean"}
"""Viewers know no type that permits null: what is not known is left out of a message."""
MAX_PIXELS = 2**24
"""Largest picture that is read; a few bytes can claim 4 GB."""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_PART = struct.Struct(">I4s")
"""Length and type, which every part of a PNG begins with."""
_GREY = [8, 0, 0, 0, 0]
"""Bit depth, colour type, compression, filter and interlace of the pictures of `encoded`."""
_LAST_FILTER = 4
"""Number of the last filter that a row of a PNG may begin with."""
_COMPRESSION = 1
"""Of PNG: noise cannot be compressed further, however long one tries."""


class Timestamp(Struct, frozen=True, gc=False):
    """Unix time, as Foxglove has it."""

    sec: int
    nsec: int


class FrameHead(Struct, frozen=True, gc=False):
    """A recorded frame without its picture."""

    t: Annotated[float, unit("s", "Middle of the exposure, unix.")]
    time: Annotated[float, unit("s", "The same on fishd's monotonic clock, as `time` of a tick.")]
    available: Annotated[float, unit("s", "When it could first be had, on that clock.")]
    seq: Annotated[int, note("Number of the frame in its session, from 1.")]
    session: Annotated[str, note("Names one run of the camera on one clock.")]
    exposure: Annotated[float | None, unit("s", "Its length; left out where it is not known.")] = (
        None
    )
    dropped: Annotated[int, note("Frames that the camera took but nobody got, so far.")] = 0


class ImageMessage(FrameHead, frozen=True, kw_only=True, gc=False):
    """A message of the channel: foxglove.CompressedImage, and the fields of `FrameHead`."""

    timestamp: Annotated[Timestamp, note("`t`.")]
    frame_id: Annotated[str, note("`camera`.")] = TOPIC
    data: Annotated[bytes, note("The picture, PNG in base64.")]
    format: Annotated[str, note("`png`.")] = "png"


class RecordedFrame(NamedTuple):
    """A frame of a recording."""

    t: float
    """Middle of its exposure [s, unix]."""
    time: float
    """The same on the monotonic clock of fishd, as `time` of a tick [s]."""
    available: float
    """When it could first be had, on that clock [s]."""
    seq: int
    session: str
    exposure: float | None
    """[s]"""
    pixels: NDArray[np.uint8]
    """Grey levels, shape (height, width)."""


def json_schema() -> bytes:
    """The JSON Schema of the channel, as Foxglove publishes it, with the fields of fishd."""
    properties: dict[str, Any] = {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {
                "sec": {"type": "integer", "minimum": 0},
                "nsec": {"type": "integer", "minimum": 0, "maximum": 999999999},
            },
        },
        "frame_id": {"type": "string"},
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": {"type": "string"},
    }
    for field in fields_of(FrameHead):
        described = f"{field.description} [{field.unit}]" if field.unit else field.description
        properties[field.name] = {"type": _TYPES[field.kind], "description": described}
    return msgspec.json.encode({"title": SCHEMA, "type": "object", "properties": properties})


def encoded(head: FrameHead, pixels: NDArray[np.uint8]) -> bytes:
    """The message of a frame; raises `MissingPackage` without OpenCV (extra: camera)."""
    _, png = _cv2().imencode(".png", pixels, [_cv2().IMWRITE_PNG_COMPRESSION, _COMPRESSION])
    nanoseconds = max(0, round(head.t * 1e9))
    fields = structs.asdict(head).items()
    known: dict[str, Any] = {name: UNSET if it is None else it for name, it in fields}
    message = ImageMessage(
        **known,
        timestamp=Timestamp(*divmod(nanoseconds, 10**9)),
        data=png.tobytes(),
    )
    return msgspec.json.encode(message)


decode_head: Callable[[bytes], FrameHead] = decoder(FrameHead)
"""A message without its picture; raises `msgspec.DecodeError`."""

_decode: Callable[[bytes], ImageMessage] = decoder(ImageMessage)


def decoded(payload: bytes) -> RecordedFrame:
    """The frame in a message; raises `RecordingError`, and `MissingPackage` without OpenCV."""
    cv2 = _cv2()
    try:
        message = _decode(payload)
    except msgspec.DecodeError as error:
        raise RecordingError(f"a frame that cannot be read: {error}") from None
    try:
        png = _intact_png(message.data)
    except (ValueError, struct.error, zlib.error) as error:
        why = str(error) if isinstance(error, _NoPicture) else "is damaged"
        raise RecordingError(f"the picture of frame {message.seq} {why}") from None
    pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise RecordingError(f"the picture of frame {message.seq} cannot be read")
    return RecordedFrame(
        message.t,
        message.time,
        message.available,
        message.seq,
        message.session,
        message.exposure,
        np.asarray(pixels, np.uint8),
    )


class _NoPicture(ValueError):
    """Reason why a picture is refused, in words."""


def _intact_png(data: bytes) -> bytes:
    """The parts of a grey PNG that its pixels are made of; raises ValueError and others.

    For what is damaged, libpng would write to standard error, and what claims to be large it would
    allocate.
    """
    if not data.startswith(_SIGNATURE):
        raise _NoPicture("is no PNG" if data else "is empty")
    kept, compressed, offset, kind = [_SIGNATURE], [], len(_SIGNATURE), b""
    height = width = 0
    while kind != b"IEND":
        length, kind = _PNG_PART.unpack_from(data, offset)
        end = offset + _PNG_PART.size + length
        body = data[offset + _PNG_PART.size : end]
        if zlib.crc32(data[offset + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise ValueError("checksum")
        if (kind == b"IHDR") != (len(kept) == 1):
            raise ValueError("order")
        if kind == b"IHDR":
            width, height, *form = struct.unpack(">II5B", body)
            if form != _GREY:
                raise _NoPicture("is a PNG that is not of 8-bit grey levels")
            if not 0 < width * height <= MAX_PIXELS:
                raise _NoPicture(f"claims {width} x {height} px, {MAX_PIXELS} pixels at most")
        if kind == b"IDAT":
            compressed.append(body)
        if kind in (b"IHDR", b"IDAT", b"IEND"):
            kept.append(data[offset : end + 4])
        offset = end + 4
    size = height * (1 + width)
    inflater = zlib.decompressobj()
    rows = inflater.decompress(b"".join(compressed), size + 1)
    if len(rows) != size or not inflater.eof or max(rows[:: 1 + width]) > _LAST_FILTER:
        raise ValueError("content")
    return b"".join(kept)


def _cv2() -> Any:
    try:
        import cv2
    except ImportError:
        raise MissingPackage(
            "frames of a camera need opencv-python-headless: pip install 'fishd[camera]'"
        ) from None
    return cv2
