"""Frames of a camera in a recording: PNG in a message that Foxglove and Lichtblick show.

The schema is foxglove.CompressedImage, as JSON, with additional fields of fishd, which viewers
ignore. PNG is lossless, so that policies can be trained with recorded frames.
"""

import struct
import zlib
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import UNSET, Struct, structs

from fishd.core.camera_frames import FrameHead, Pixels
from fishd.core.decoding import decoder
from fishd.core.errors import MissingPackage, RecordingError
from fishd.core.schema import fields_of, note

IMAGE_TOPIC, TAIL_TOPIC = "camera", "tail"
IMAGE_SCHEMA = "foxglove.CompressedImage"
_TYPES = {"number": "number", "integer": "integer", "text": "string", "boolean": "boolean"}
"""JSON types of fields. Viewers do not support null: unknown values are omitted in a message."""
MAX_PIXELS = 2**24
"""Maximum number of pixels of a picture that is read; a few bytes can claim 4 GB."""
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_CHUNK_HEAD = struct.Struct(">I4s")
"""Length and type, at the beginning of every chunk of a PNG."""
_GREY_FORMAT = [8, 0, 0, 0, 0]
"""Bit depth, colour type, compression, filter and interlace of pictures by `encode_frame`."""
_COMPRESSION_LEVEL = 1
"""Compression level of PNG: higher levels take longer, but do not compress noise further."""


class Timestamp(Struct, frozen=True, gc=False):
    """Unix time in Foxglove's representation."""

    sec: int
    nsec: int


class ImageMessage(FrameHead, frozen=True, kw_only=True, gc=False):
    """Message of the channel: foxglove.CompressedImage with the fields of `FrameHead`."""

    timestamp: Annotated[Timestamp, note("Same as `t`.")]
    frame_id: Annotated[str, note("`camera`.")] = IMAGE_TOPIC
    data: Annotated[bytes, note("The picture, PNG in base64.")]
    format: Annotated[str, note("`png`.")] = "png"


class RecordedFrame(NamedTuple):
    """A frame of a recording."""

    t: float
    """Middle of the exposure [s, unix]."""
    time: float
    """Middle of the exposure on the monotonic clock of fishd, as `time` of a tick [s]."""
    available: float
    """Time of arrival of the frame, on that clock [s]."""
    seq: int
    session: str
    exposure: float | None
    """Duration of the exposure [s]; None if unknown."""
    pixels: Pixels
    """Grey levels, shape (height, width)."""


def image_json_schema() -> bytes:
    """Return the JSON Schema of the channel: Foxglove's, with additional fields of fishd."""
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
        description = f"{field.description} [{field.unit}]" if field.unit else field.description
        properties[field.name] = {"type": _TYPES[field.kind], "description": description}
    return msgspec.json.encode({"title": IMAGE_SCHEMA, "type": "object", "properties": properties})


def encode_frame(head: FrameHead, pixels: Pixels) -> bytes:
    """Return the message of a frame; raise `MissingPackage` without OpenCV (extra: camera)."""
    _, png = _cv2().imencode(".png", pixels, [_cv2().IMWRITE_PNG_COMPRESSION, _COMPRESSION_LEVEL])
    nanoseconds = max(0, round(head.t * 1e9))
    fields = structs.asdict(head).items()
    known: dict[str, Any] = {name: UNSET if value is None else value for name, value in fields}
    message = ImageMessage(
        **known,
        timestamp=Timestamp(*divmod(nanoseconds, 10**9)),
        data=png.tobytes(),
    )
    return msgspec.json.encode(message)


decode_head: Callable[[bytes], FrameHead] = decoder(FrameHead)
"""Decoder of a message without its picture; raises `msgspec.DecodeError`."""

_decode: Callable[[bytes], ImageMessage] = decoder(ImageMessage)


def decode_frame(payload: bytes) -> RecordedFrame:
    """Return the frame in a message; raise `RecordingError`, or `MissingPackage` without OpenCV."""
    cv2 = _cv2()
    try:
        message = _decode(payload)
    except msgspec.DecodeError as error:
        raise RecordingError(f"a frame that cannot be read: {error}") from None
    try:
        _check_png(message.data)
    except (ValueError, struct.error) as error:
        why = str(error) if isinstance(error, _InvalidPicture) else "is damaged"
        raise RecordingError(f"the picture of frame {message.seq} {why}") from None
    import numpy as np  # so does cv2

    pixels = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
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


class _InvalidPicture(ValueError):
    """A picture is refused; the message is the reason."""


def _check_png(data: bytes) -> None:
    """Raise ValueError, or `struct.error`, unless this is a grey PNG of limited size, undamaged.

    libpng itself would write to standard error for damaged data, and allocate whatever size the
    data claim.
    """
    if not data.startswith(_SIGNATURE):
        raise _InvalidPicture("is not a PNG" if data else "is empty")
    offset, kind = len(_SIGNATURE), b""
    width, height, *form = struct.unpack_from(">II5B", data, offset + _PNG_CHUNK_HEAD.size)
    if form != _GREY_FORMAT:
        raise _InvalidPicture("is not a PNG of 8-bit grey levels")
    if not 0 < width * height <= MAX_PIXELS:
        raise _InvalidPicture(f"claims {width} x {height} px, {MAX_PIXELS} pixels at most")
    while kind != b"IEND":
        length, kind = _PNG_CHUNK_HEAD.unpack_from(data, offset)
        end = offset + _PNG_CHUNK_HEAD.size + length
        if zlib.crc32(data[offset + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise ValueError("checksum")
        offset = end + 4


def _cv2() -> Any:
    try:
        import cv2
    except ImportError:
        purpose = "a recorded frame of a camera"
        raise MissingPackage.of_extra(purpose, "opencv-python-headless", "camera") from None
    return cv2
