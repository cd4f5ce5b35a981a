"""What `fishd-camera` says: frames, views for people, its state; see docs/how-to/camera.md.

Each message of the PUB socket is a topic and one JSON object; behind that of a frame or a view
comes the picture. Requests are those of fishd's control protocol (`fishd.core.protocol`).
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct

from fishd.core.camera_frames import Pixels
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError
from fishd.core.schema import note, unit

VERSION = 1
FRAME, VIEW, STATE, UNTIL = b"frame", b"view", b"state", b"until"
"""The topics."""
LARGEST = 256
"""Height and width of a frame [px]."""

EARLIEST = -2.0
"""No frame is there so long before the middle of its exposure: `delay` of a camera's settings may
move its time by a second [s]."""
_POSSIBLE = {"ge": -1e9, "le": 1e9}
"""Times: 30 years, beyond which nothing could be told from the clock of a machine [s]."""

_Version = Annotated[int, note("Version of these messages: 1.")]
_Session = Annotated[
    str,
    note("Names one run of the camera on one clock; in another one, times and numbers restart."),
]
_Width = Annotated[int, unit("px", "Columns of the picture.", ge=1, le=8192)]
_Height = Annotated[int, unit("px", "Its rows.", ge=1, le=8192)]
_FrameTime = Annotated[
    float,
    unit(
        "s",
        "Middle of the exposure, on the camera's clock: the monotonic one of its machine; of a "
        "simulated camera that of fishd, which in lockstep is virtual.",
        **_POSSIBLE,
    ),
]


class BadMessage(FishdError, ValueError):
    """What came is no message of a camera, or one of another version."""


class FrameHeader(Struct, frozen=True, kw_only=True, gc=False):
    """Topic `frame`; behind it height · width bytes, grey levels row by row."""

    v: _Version = VERSION
    session: _Session
    seq: Annotated[
        int, note("Number of the frame in its session, from 1; a gap means that messages were lost")
    ]
    time: _FrameTime
    available: Annotated[
        float,
        unit("s", "When it could first be had, on the same clock.", **_POSSIBLE),
    ]
    exposure: Annotated[float | None, unit("s", "Its length; null where it is not known.")] = None
    dropped: Annotated[
        int, note("Frames that the camera took but did not deliver, since its process began.", ge=0)
    ] = 0
    virtual: Annotated[bool, note("True where the clock is the virtual one of a lockstep.")] = False
    width: Annotated[int, unit("px", "Columns of the picture.", ge=1, le=LARGEST)]
    height: Annotated[int, unit("px", "Its rows.", ge=1, le=LARGEST)]


class Crop(Struct, frozen=True, kw_only=True):
    """A rectangle in a picture, as shares of its width and height."""

    left: float
    top: float
    width: float
    height: float


class ViewHeader(Struct, frozen=True, kw_only=True):
    """Topic `view`; behind it a JPEG of the camera's whole picture, rotated as frames are."""

    v: _Version = VERSION
    session: _Session
    seq: Annotated[int, note("Number of the frame that was taken from the same picture.")]
    time: _FrameTime
    width: _Width
    height: _Height
    crop: Annotated[
        Crop, note("What frames show of it: `left`, `top`, `width`, `height`, as shares of it.")
    ]


class Until(Struct, frozen=True, kw_only=True, gc=False):
    """Topic `until`, in lockstep only: all frames that were to be had by then are published."""

    v: _Version = VERSION
    session: _Session
    until: Annotated[float, unit("s", "On the camera's clock.", **_POSSIBLE)]


Condition = Literal["starting", "waiting", "streaming", "stalled", "unplugged", "unusable", "ended"]
CONDITIONS: dict[Condition, str] = {
    "starting": "the process has just begun",
    "waiting": "a simulated camera: there is no fishd, or it does not tick",
    "streaming": "frames come",
    "stalled": "the camera is there, but no whole frame has come for a while; it is opened again",
    "unplugged": "there is no such camera, file or stream; it is looked for",
    "unusable": "it is there, but cannot be used as the settings say; it is tried again",
    "ended": "the file is at its end, and is not played again",
}
"""What a camera may be in, and what that means."""


class CameraState(Struct, frozen=True, kw_only=True):
    """Topic `state`, twice a second and after every change; also the answer to `status`."""

    v: _Version = VERSION
    t: Annotated[float, unit("s", "When, unix.")]
    version: Annotated[str, note("Version of fishd.")]
    pid: Annotated[int, note("The camera's process.")]
    uptime: Annotated[float, unit("s", "Since it began.")]
    session: _Session
    source: Annotated[str, note("`simulated`, `v4l2` or `stream`.")]
    device: Annotated[str, note("What it opens: a device, a file or URL, or the address of fishd.")]
    state: Annotated[Condition, note("What it is in, see below.")]
    since: Annotated[float, unit("s", "Since when, unix.")]
    problem: Annotated[str, note("One line that says why; empty while frames come.")] = ""
    remedy: Annotated[str, note("What to do about it.")] = ""
    degraded: Annotated[
        tuple[str, ...], note("What keeps the times or pictures from being as good as could be.")
    ] = ()
    rate: Annotated[float, unit("1/s", "Frames a second of late; 0.0 where none come.")] = 0.0
    latency: Annotated[
        float | None,
        unit("s", "From the middle of the exposure until the frame could be had, mean of late."),
    ] = None
    exposure: Annotated[float | None, unit("s", "Length of the exposure; null: not known.")] = None
    seq: Annotated[int, note("Number of the latest frame; 0 for none.")] = 0
    dropped: Annotated[
        int, note("Frames that the camera took but did not deliver, since start.")
    ] = 0
    broken: Annotated[int, note("Frames that could not be decoded, since start.")] = 0
    width: Annotated[int, unit("px", "Width of frames.")]
    height: Annotated[int, unit("px", "Height of frames.")]
    picture_width: Annotated[int, unit("px", "Width of the camera's own pictures; 0: none yet.")]
    picture_height: Annotated[int, unit("px", "Their height.")]
    virtual: Annotated[bool, note("True where the clock is the virtual one of a lockstep.")] = False
    until: Annotated[
        Annotated[float, Meta(**_POSSIBLE)] | None,
        unit("s", "That of the latest message `until` of this session."),
    ] = None
    clock: Annotated[
        Annotated[float, Meta(**_POSSIBLE)] | None,
        unit("s", "Now, on the camera's clock; null where that is virtual, or not known yet."),
    ] = None
    boot: Annotated[str, note("Names the start of the machine from which that clock counts.")] = ""
    frames: Annotated[str, note("Address of the PUB socket.")]


class PublishedFrame(NamedTuple):
    """A frame as it came."""

    header: FrameHeader
    pixels: Pixels


class PublishedView(NamedTuple):
    """A view as it came."""

    header: ViewHeader
    jpeg: bytes


Message = PublishedFrame | PublishedView | CameraState | Until

_encode = msgspec.json.Encoder().encode


def frame(header: FrameHeader, pixels: Pixels) -> list[bytes]:
    """The parts of a message."""
    return [FRAME, _encode(header), pixels.tobytes()]


def view(header: ViewHeader, jpeg: bytes) -> list[bytes]:
    """The parts of a message."""
    return [VIEW, _encode(header), jpeg]


def state(state: CameraState) -> list[bytes]:
    """The parts of a message."""
    return [STATE, _encode(state)]


def until(until: Until) -> list[bytes]:
    """The parts of a message."""
    return [UNTIL, _encode(until)]


_decoders: dict[bytes, Any] = {
    FRAME: decoder(FrameHeader),
    VIEW: decoder(ViewHeader),
    STATE: decoder(CameraState),
    UNTIL: decoder(Until),
}


class _OnlyVersion(Struct):
    v: int


_decode_version: Callable[[bytes], _OnlyVersion] = decoder(_OnlyVersion)


def decode(parts: Sequence[bytes]) -> Message:
    """The message in these parts; raises `BadMessage`."""
    topic = parts[0]
    if topic not in _decoders:
        raise BadMessage(f"topic {topic[:20]!r} is none of a camera's")
    name, wanted = topic.decode(), 3 if topic in (FRAME, VIEW) else 2
    if len(parts) != wanted:
        raise BadMessage(f"a message of topic {name} has {wanted} parts, not {len(parts)}")
    try:
        version = _decode_version(parts[1]).v
        if version != VERSION:
            raise BadMessage(
                f"a message of topic {name} in version {version}; version {VERSION} is needed: "
                "let camera and client be of the same fishd"
            )
        header: FrameHeader | ViewHeader | CameraState | Until = _decoders[topic](parts[1])
    except msgspec.DecodeError as error:
        raise BadMessage(f"a message of topic {name} that cannot be read: {error}") from None
    if isinstance(header, FrameHeader):
        age = header.available - header.time
        if age < EARLIEST:
            raise BadMessage(f"a frame that was there {-age:g} s before it was exposed")
        size = header.height * header.width
        if len(parts[2]) != size:
            raise BadMessage(
                f"a frame of {header.width} x {header.height} px has {size} bytes, not "
                f"{len(parts[2])}"
            )
        pixels = np.frombuffer(parts[2], np.uint8).reshape(header.height, header.width)
        return PublishedFrame(header, pixels)
    if isinstance(header, ViewHeader):
        return PublishedView(header, parts[2])
    return header
