"""Settings of `fishd-camera` from a YAML file: the source, the picture and the addresses."""

import os
import re
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from fishd.camera.simulated import SimulatedCameraSettings
from fishd.core import strict_yaml, text
from fishd.core.addresses import find_connect_problem, find_listen_problem
from fishd.core.errors import ConfigError
from fishd.core.overrides import apply_overrides
from fishd.core.schema import PRINTABLE, Problem, convert, drop_empty_sections, note, unit

_Delay = Annotated[
    float,
    unit(
        "s",
        "Delay of time stamps after the middle of the exposure, beyond that by its duration.",
        ge=-1,
        le=5,
    ),
]
_SCHEMES = ("rtsp", "rtsps", "http", "https", "rtp", "udp", "tcp")
_VALUE = re.compile("=[^&/;]*")
_Text = Annotated[str, Meta(min_length=1, max_length=500, pattern=PRINTABLE)]


class V4l2Settings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a camera of this machine."""

    device: Annotated[
        str,
        note(
            "Device file: /dev/video0, or a persistent name in /dev/v4l/by-id.",
            min_length=1,
            max_length=500,
            pattern=PRINTABLE,
        ),
    ] = "/dev/video0"
    width: Annotated[int, unit("px", "Width of the camera's pictures.", ge=16, le=8192)] = 640
    height: Annotated[int, unit("px", "Height of the camera's pictures.", ge=16, le=8192)] = 480
    rate: Annotated[float, unit("1/s", "Frames per second.", gt=0, le=1000)] = 30.0
    format: Annotated[
        Literal["MJPG", "YUYV", "GREY"],
        note("Pixel format; most web cameras are fast with MJPG only."),
    ] = "MJPG"
    controls: Annotated[
        dict[str, Any],
        note(
            "Controls by the names of 'v4l2-ctl --list-ctrls', such as auto_exposure: 1; a fixed "
            "exposure and gain keep brightness and rate constant."
        ),
    ] = {}
    delay: _Delay = 0.0


class StreamSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a video file, or of the stream of a network camera."""

    url: Annotated[
        _Text | None,
        note(
            "Path of a video file, or rtsp://USER:PASSWORD@HOST/PATH; required for source stream."
        ),
    ] = None
    rate: Annotated[
        Annotated[float, Meta(gt=0, le=1000)] | None,
        unit("1/s", "Frames per second of a file; null: as it states."),
    ] = None
    loop: Annotated[bool, note("Whether to repeat a file.")] = True
    delay: _Delay = 0.0


class SimulatedSettings(SimulatedCameraSettings, frozen=True, kw_only=True):
    """Settings of a camera above a simulated fish, which draws the tail from fishd's telemetry."""

    width: Annotated[int, unit("px", "Width of a picture.", ge=16, le=1920)] = 640
    height: Annotated[int, unit("px", "Height of a picture.", ge=16, le=1080)] = 480
    fishd: Annotated[
        str | None,
        note("Control address of fishd; null: that of fishctl."),
    ] = None


class Square(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Square in a picture; a square that extends beyond the picture's edge is moved inside."""

    x: Annotated[
        float, unit("1", "Middle of the square, as a fraction of the width.", ge=0, le=1)
    ] = 0.5
    y: Annotated[
        float, unit("1", "Middle of the square, as a fraction of the height.", ge=0, le=1)
    ] = 0.5
    side: Annotated[
        float, unit("1", "Side of the square, as a fraction of the shorter side.", ge=0.05, le=1)
    ] = 1.0


class PictureSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of frames, which show the fish's axis along the rows, its head to the left."""

    rotate: Annotated[
        Literal[0, 90, 180, 270], note("Clockwise rotation of the camera's picture [degrees].")
    ] = 0
    crop: Annotated[Square, note("The part of the turned picture that frames show.")] = Square()
    size: Annotated[
        int, unit("px", "Height and width of a frame, by averaging over areas.", ge=16, le=256)
    ] = 84


class TailSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the measurement of the fin angle in whole pictures."""

    measure: Annotated[
        bool,
        note("Whether to measure, once the tail is learned."),
    ] = True
    learned: Annotated[
        _Text | None,
        note(
            "File of what was learned; null: one per settings file, in ~/.local/state/fishd, or "
            "for the service /var/lib/fishd-camera."
        ),
    ] = None
    read_out: Annotated[
        float,
        unit(
            "s",
            "Time from the exposure of the first row to that of the last.",
            ge=0,
            le=0.2,
        ),
    ] = 0.0


class PublishSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Addresses at which frames are published and requests are answered."""

    frames: Annotated[
        str,
        note(
            "ZeroMQ address of the PUB socket: tcp://HOST:PORT or ipc://PATH; all that can connect "
            "receive the pictures."
        ),
    ] = "tcp://127.0.0.1:9874"
    requests: Annotated[str, note("The same for requests.")] = "tcp://127.0.0.1:9875"
    view_rate: Annotated[
        float,
        unit("1/s", "Views (for people) per second; 0: none.", ge=0, le=5),
    ] = 5.0
    view_width: Annotated[int, unit("px", "Largest width of views.", ge=84, le=1920)] = 480
    view_quality: Annotated[int, note("JPEG quality of views.", ge=10, le=100)] = 80


class CameraSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All settings; the defaults are a simulated camera above the fish of this machine."""

    source: Annotated[
        Literal["simulated", "v4l2", "stream"],
        note("A simulated camera, a camera of this machine, or a file or network camera."),
    ] = "simulated"
    simulated: Annotated[
        SimulatedSettings, note("The simulated camera: timing, optics and light.")
    ] = SimulatedSettings()
    v4l2: Annotated[V4l2Settings, note("A camera of this machine.")] = V4l2Settings()
    stream: Annotated[StreamSettings, note("A file or a network camera.")] = StreamSettings()
    picture: Annotated[
        PictureSettings,
        note("The part of the picture that frames show; learning in simulation does not use it."),
    ] = PictureSettings()
    tail: Annotated[TailSettings, note("Measurement of the fin angle.")] = TailSettings()
    publish: Annotated[PublishSettings, note("Addresses of frames and requests.")] = (
        PublishSettings()
    )


def load(
    path: str | os.PathLike[str] | None = None, overrides: Iterable[str] = ()
) -> CameraSettings:
    """Return the settings in a file, or the defaults, with `KEY=VALUE` overrides.

    Raises `ConfigError`, which names file, line and key.
    """
    data, sources = (
        strict_yaml.read(path, "a camera", "source: v4l2") if path is not None else ({}, {})
    )
    sources |= apply_overrides(data, overrides)
    try:
        settings = convert(drop_empty_sections(data, CameraSettings), CameraSettings)
        _check(settings)
        return settings
    except Problem as problem:
        raise ConfigError(problem.message_with_place(sources)) from None


def load_simulated(path: str | os.PathLike[str] | None = None) -> SimulatedSettings:
    """Return the simulated camera in a file, or the default one.

    Raises `ConfigError` as `load` does, and for a file with another source and for an address.
    """
    needed = "in simulation a simulated camera is needed, such as config/camera-web.yaml"
    if path is not None and "://" in str(path):
        raise ConfigError(
            f"'{text.quoted(str(path))}' is the address of a running fishd-camera, which sees the "
            f"fish of a running fishd; {needed}"
        )
    settings = load(path)
    if settings.source != "simulated":
        raise ConfigError(f"{path}: source is {settings.source}; {needed}")
    return settings.simulated


def without_password(settings: CameraSettings) -> CameraSettings:
    """Return settings that clients may read, without a password."""
    url = settings.stream.url
    if url is None:
        return settings
    return replace(settings, stream=replace(settings.stream, url=hide_secrets(url)))


def hide_secrets(url: str) -> str:
    """Return the path of a file, or a URL without possible secrets: user, password and values."""
    scheme, separator, rest = url.partition("://")
    if not separator:
        return url
    place, slash, path = rest.partition("/")
    return f"{scheme}://{place.rpartition('@')[2]}{slash}{_VALUE.sub('=…', path)}"


def to_yaml(settings: CameraSettings) -> str:
    """Return all settings, including defaults, as YAML that `load` reads."""
    return strict_yaml.dump(msgspec.to_builtins(settings))


def _check(settings: CameraSettings) -> None:
    """Raise `Problem` for values that are valid on their own but not together."""
    publish, stream = settings.publish, settings.stream
    for key, address in (("frames", publish.frames), ("requests", publish.requests)):
        if complaint := find_listen_problem(address):
            raise Problem(("publish", key), f"'{address}' is not valid: {complaint}")
    if publish.frames == publish.requests and not publish.frames.endswith(":0"):
        raise Problem(("publish", "requests"), f"'{publish.requests}' is that of frames already")
    if settings.source == "stream" and not stream.url:
        raise Problem(
            ("stream", "url"), "is missing: the path of a video file, or rtsp://HOST/PATH is needed"
        )
    scheme, separator, _ = (stream.url or "").partition("://")
    if separator and scheme not in _SCHEMES:
        raise Problem(
            ("stream", "url"),
            f"'{text.quoted(scheme)}://' is not valid: the path of a file, or a URL that begins "
            f"with one of {', '.join(_SCHEMES)} is needed",
        )
    for name, value in settings.v4l2.controls.items():
        if not isinstance(value, int):
            raise Problem(
                ("v4l2", "controls", name),
                f"{value!r} is not valid: a whole number, true or false is needed",
            )
    fishd = settings.simulated.fishd
    if fishd is not None and (complaint := find_connect_problem(fishd)):
        raise Problem(("simulated", "fishd"), f"'{fishd}' is not valid: {complaint}")
