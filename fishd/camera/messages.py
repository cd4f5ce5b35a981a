"""Messages of `fishd-camera`: frames, views for people, fin angles, its state.

Each message of the PUB socket is a topic and one JSON object, followed by the picture in a frame or
a view; docs/reference/protocol.md has the fields. Requests have the format of fishd's control
protocol (`fishd.core.protocol`).
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct

from fishd.core.camera_frames import Pixels
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError, Refused
from fishd.core.schema import note, unit
from fishd.core.tail_reading import TailReading

VERSION = 2
FRAME, VIEW, TAIL, STATE, UNTIL = b"frame", b"view", b"tail", b"state", b"until"
"""Topics of the messages."""
MAX_FRAME_SIZE_PX = 256
"""Largest height and width of a frame [px]."""

MIN_AGE_S = -2.0
"""Smallest time from the middle of a frame's exposure until the frame is available; it may be
negative, because `delay` of a camera's settings moves the time of a frame [s]."""
_TIME_RANGE = {"ge": -1e9, "le": 1e9}
"""Range of valid times, 30 years, in which a clock has a good resolution [s]."""

_Version = Annotated[int, note("Version of these messages: 2.")]
_Session = Annotated[
    str,
    note(
        "Identifier of a run of the camera on one clock; in a new one, times and numbers restart."
    ),
]
_Width = Annotated[int, unit("px", "Columns.", ge=1, le=8192)]
_Height = Annotated[int, unit("px", "Rows.", ge=1, le=8192)]
_FrameTime = Annotated[
    float,
    unit(
        "s",
        "Middle of the exposure, on the camera's clock: the monotonic clock of its machine, or for "
        "a simulated camera that of fishd, which is virtual in lockstep.",
        **_TIME_RANGE,
    ),
]


class BadMessage(FishdError, ValueError):
    """A message is not one of a camera, or has another version."""


class FrameHeader(Struct, frozen=True, kw_only=True, gc=False):
    """Topic `frame`, followed by height · width bytes, grey levels row by row."""

    v: _Version = VERSION
    session: _Session
    seq: Annotated[int, note("Number of the frame in its session, from 1; gaps are lost messages")]
    time: _FrameTime
    available: Annotated[
        float,
        unit("s", "Time at which the frame was available, on that clock.", **_TIME_RANGE),
    ]
    exposure: Annotated[float | None, unit("s", "Exposure time; null where it is unknown.")] = None
    dropped_frames: Annotated[
        int, note("Frames that were taken but not delivered, since start.", ge=0)
    ] = 0
    virtual: Annotated[bool, note("True where the clock is the virtual one of a lockstep.")] = False
    width: Annotated[int, unit("px", "Columns.", ge=1, le=MAX_FRAME_SIZE_PX)]
    height: Annotated[int, unit("px", "Rows.", ge=1, le=MAX_FRAME_SIZE_PX)]


class Crop(Struct, frozen=True, kw_only=True):
    """Rectangle in a picture, as fractions of the picture's width and height."""

    left: float
    top: float
    width: float
    height: float


class ViewHeader(Struct, frozen=True, kw_only=True):
    """Topic `view`, followed by a JPEG of the camera's whole picture, rotated as frames are."""

    v: _Version = VERSION
    session: _Session
    seq: Annotated[int, note("Number of the frame from the same picture.")]
    time: _FrameTime
    width: _Width
    height: _Height
    crop: Annotated[
        Crop,
        note("Part that frames show: `left`, `top`, `width`, `height`, in fractions of the view."),
    ]


class TailMessage(TailReading, frozen=True, kw_only=True):
    """Topic `tail`: what a whole picture shows of the tail."""

    v: _Version = VERSION
    session: _Session
    seq: Annotated[int, note("Number of the frame from the same picture.")]
    time: Annotated[
        float,
        unit("s", "Middle of the exposure of the fin's row, on the camera's clock.", **_TIME_RANGE),
    ]


class Until(Struct, frozen=True, kw_only=True, gc=False):
    """Topic `until`, in lockstep only: all frames available by that time have been published."""

    v: _Version = VERSION
    session: _Session
    until: Annotated[float, unit("s", "Time on the camera's clock.", **_TIME_RANGE)]


Condition = Literal["starting", "waiting", "streaming", "stalled", "unplugged", "unusable", "ended"]
CONDITIONS: dict[Condition, str] = {
    "starting": "the process has just begun",
    "waiting": "a simulated camera waits for a fishd that ticks",
    "streaming": "frames arrive",
    "stalled": "the camera is connected, but no frame has come for a while; it is opened again",
    "unplugged": "there is no such camera, file or stream; fishd-camera keeps looking",
    "unusable": "it cannot be used with these settings; fishd-camera keeps trying",
    "ended": "the file is at its end, and is not repeated",
}
"""Conditions of a camera and their meanings."""


TailCondition = Literal["off", "unlearned", "learning", "measuring", "unusable"]
"""Condition of the measurement of the fin angle."""


class CameraState(Struct, frozen=True, kw_only=True):
    """Topic `state`, sent twice a second and after every change; also the answer to `status`."""

    v: _Version = VERSION
    t: Annotated[float, unit("s", "Time of the message, Unix time.")]
    version: Annotated[str, note("Version of fishd.")]
    pid: Annotated[int, note("Process id of fishd-camera.")]
    uptime: Annotated[float, unit("s", "Time since the process began.")]
    session: _Session
    source: Annotated[str, note("`simulated`, `v4l2` or `stream`.")]
    device: Annotated[str, note("Device, file, URL, or address of fishd that it opens.")]
    state: Annotated[Condition, note("Condition, see below.")]
    since: Annotated[float, unit("s", "Start of the condition, Unix time.")]
    problem: Annotated[str, note("Reason in one line; empty while frames arrive.")] = ""
    remedy: Annotated[str, note("Instruction that solves the problem.")] = ""
    limitations: Annotated[
        tuple[str, ...], note("Why times or pictures are worse than possible.")
    ] = ()
    rate: Annotated[float, unit("1/s", "Recent frames per second; 0.0 where none arrive.")] = 0.0
    latency: Annotated[
        float | None,
        unit("s", "Recent mean time from exposure until the frame is available."),
    ] = None
    exposure: Annotated[float | None, unit("s", "Exposure time; null where it is unknown.")] = None
    seq: Annotated[int, note("Number of the latest frame; 0: none yet.")] = 0
    dropped_frames: Annotated[
        int, note("Frames that were taken but not delivered, since start.")
    ] = 0
    broken_frames: Annotated[int, note("Frames that could not be decoded, since start.")] = 0
    width: Annotated[int, unit("px", "Columns.")]
    height: Annotated[int, unit("px", "Rows.")]
    picture_width: Annotated[int, unit("px", "Width of whole pictures; 0: none yet.")]
    picture_height: Annotated[int, unit("px", "Height of whole pictures.")]
    virtual: Annotated[bool, note("True where the clock is the virtual one of a lockstep.")] = False
    until: Annotated[
        Annotated[float, Meta(**_TIME_RANGE)] | None,
        unit("s", "Time in the latest message `until` of this session."),
    ] = None
    clock: Annotated[
        Annotated[float, Meta(**_TIME_RANGE)] | None,
        unit("s", "Camera's clock now; null where virtual or unknown."),
    ] = None
    boot_id: Annotated[str, note("Identifier of the boot from which that clock counts.")] = ""
    frames: Annotated[str, note("Address of the PUB socket.")]
    tail: Annotated[
        TailCondition,
        note(
            "`off`, `unlearned`, `learning`, `measuring`, or `unusable`: its file cannot be used."
        ),
    ] = "off"
    tail_problem: Annotated[
        str, note("Why it does not measure, or has not learned; else empty.")
    ] = ""
    tail_learned: Annotated[str, note("Date of learning; empty: never.")] = ""
    tail_zero_ci95: Annotated[
        float | None, unit("rad", "Half-width of the 95 % interval of the learned zero.")
    ] = None
    lens: Annotated[
        str, note("Date of the calibration of the lens, and its errors; empty: never.")
    ] = ""
    measured_pictures: Annotated[int, note("Measured pictures, since start.")] = 0
    unmeasured_pictures: Annotated[
        int, note("Pictures without time to measure them, since start.")
    ] = 0

    def refuse_unmeasured(self) -> None:
        """Raise `Refused` where the camera does not measure the fin angle."""
        if self.tail in ("measuring", "learning"):
            return
        remedies = {
            "off": "tail.measure is false in its settings",
            "unlearned": "it has not learned the tail: run 'fishctl camera measure --learn'",
        }
        reason = self.tail_problem or remedies.get(self.tail, self.tail)
        raise Refused("tail-unknown", f"this camera measures no fin angle: {reason}")


class PublishedFrame(NamedTuple):
    """Received frame."""

    header: FrameHeader
    pixels: Pixels


class PublishedView(NamedTuple):
    """Received view."""

    header: ViewHeader
    jpeg: bytes


Message = PublishedFrame | PublishedView | TailMessage | CameraState | Until

Header = FrameHeader | ViewHeader | TailMessage | CameraState | Until
TOPICS: dict[type[Header], bytes] = {
    FrameHeader: FRAME,
    ViewHeader: VIEW,
    TailMessage: TAIL,
    CameraState: STATE,
    Until: UNTIL,
}
_decoders: dict[bytes, Any] = {topic: decoder(kind) for kind, topic in TOPICS.items()}


def encode(header: Header, *picture: bytes) -> list[bytes]:
    """Return the parts of a message; picture: that of a frame or a view."""
    return [TOPICS[type(header)], msgspec.json.encode(header), *picture]


class _OnlyVersion(Struct):
    v: int


_decode_version: Callable[[bytes], _OnlyVersion] = decoder(_OnlyVersion)


def decode(parts: Sequence[bytes]) -> Message:
    """Return the message in these parts; raises `BadMessage`."""
    topic = parts[0]
    if topic not in _decoders:
        raise BadMessage(f"topic {topic[:20]!r} is not a topic of a camera")
    name, part_count = topic.decode(), 3 if topic in (FRAME, VIEW) else 2
    if len(parts) != part_count:
        raise BadMessage(f"a message of topic {name} has {part_count} parts, not {len(parts)}")
    try:
        version = _decode_version(parts[1]).v
        if version != VERSION:
            raise BadMessage(
                f"a message of topic {name} in version {version}; version {VERSION} is needed: "
                "install the same version of fishd for camera and client"
            )
        header: Header = _decoders[topic](parts[1])
    except msgspec.DecodeError as error:
        raise BadMessage(f"a message of topic {name} that cannot be read: {error}") from None
    if isinstance(header, FrameHeader):
        age = header.available - header.time
        if age < MIN_AGE_S:
            raise BadMessage(f"a frame was available {-age:g} s before its exposure")
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
