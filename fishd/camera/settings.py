"""The settings of `fishd-camera`, from a YAML file: what it opens, shows and publishes."""

import os
import re
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.core import strict_yaml, text
from fishd.core.addresses import why_not_connected, why_not_served
from fishd.core.errors import ConfigError
from fishd.core.overrides import apply_overrides
from fishd.core.schema import PRINTABLE, Problem, convert, note, unit, without_empty_sections

_Delay = Annotated[
    float,
    unit(
        "s",
        "So much earlier than its time stamp says was the middle of a frame's exposure, beyond "
        "what the exposure explains.",
        ge=-1,
        le=5,
    ),
]
_SCHEMES = ("rtsp", "rtsps", "http", "https", "rtp", "udp", "tcp")
_VALUE = re.compile("=[^&/;]*")
_Text = Annotated[str, Meta(min_length=1, max_length=500, pattern=PRINTABLE)]


class V4l2Settings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A camera of this machine."""

    device: Annotated[
        str,
        note(
            "Its file: /dev/video0, or a lasting name in /dev/v4l/by-id.",
            min_length=1,
            max_length=500,
            pattern=PRINTABLE,
        ),
    ] = "/dev/video0"
    width: Annotated[int, unit("px", "Width of its pictures.", ge=16, le=8192)] = 640
    height: Annotated[int, unit("px", "Their height.", ge=16, le=8192)] = 480
    rate: Annotated[float, unit("1/s", "Frames per second.", gt=0, le=1000)] = 30.0
    format: Annotated[
        Literal["MJPG", "YUYV", "GREY"],
        note("How it sends them; most web cameras reach their rate with MJPG only."),
    ] = "MJPG"
    controls: Annotated[
        dict[str, Any],
        note(
            "Controls to set, by name as 'v4l2-ctl --list-ctrls' shows them: fixed exposure and "
            "gain, so that light and rate stay, such as auto_exposure: 1."
        ),
    ] = {}
    delay: _Delay = 0.0


class StreamSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A video file, or the stream of a network camera."""

    url: Annotated[
        _Text | None,
        note("Path of a video file, or rtsp://USER:PASSWORD@HOST/PATH; source stream needs it."),
    ] = None
    rate: Annotated[
        Annotated[float, Meta(gt=0, le=1000)] | None,
        unit("1/s", "Frames per second of a file; null: its own."),
    ] = None
    loop: Annotated[bool, note("Play a file again and again.")] = True
    delay: _Delay = 0.0


class SimulatedSettings(SimulatedCameraSettings, frozen=True, kw_only=True):
    """A camera above a simulated fish, which draws the tail from fishd's telemetry."""

    fishd: Annotated[
        str | None,
        note("Control address of fishd; null: that of this machine, as fishctl finds it."),
    ] = None


class Square(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A square in a picture; one that would reach beyond its edge is moved inside."""

    x: Annotated[float, unit("1", "Its middle, as a share of the width.", ge=0, le=1)] = 0.5
    y: Annotated[float, unit("1", "Its middle, as a share of the height.", ge=0, le=1)] = 0.5
    side: Annotated[float, unit("1", "Its side, as a share of the shorter one.", ge=0.05, le=1)] = (
        1.0
    )


class PictureSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What frames show: the fish's axis along the rows, its head to the left."""

    rotate: Annotated[
        Literal[0, 90, 180, 270], note("Turn the camera's picture clockwise by this angle.")
    ] = 0
    crop: Annotated[Square, note("The part of the turned picture that frames show.")] = Square()
    size: Annotated[
        int, unit("px", "Height and width of a frame, by averaging over areas.", ge=16, le=256)
    ] = 84


class PublishSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where frames go."""

    frames: Annotated[
        str,
        note(
            "ZeroMQ address of the PUB socket: tcp://HOST:PORT or ipc://PATH. Whoever reaches it "
            "sees what the camera sees."
        ),
    ] = "tcp://127.0.0.1:9874"
    requests: Annotated[str, note("ZeroMQ address of the socket for requests, likewise.")] = (
        "tcp://127.0.0.1:9875"
    )
    view_rate: Annotated[
        float, unit("1/s", "Most pictures for people a second; 0: none.", ge=0, le=5)
    ] = 5.0
    view_width: Annotated[int, unit("px", "Their width at most.", ge=84, le=1920)] = 480
    view_quality: Annotated[int, note("Their JPEG quality.", ge=10, le=100)] = 80


class CameraSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """All of them; the defaults are a simulated camera above the fish of this machine."""

    source: Annotated[
        Literal["simulated", "v4l2", "stream"],
        note("A simulated camera, a camera of this machine, or a file or network camera."),
    ] = "simulated"
    simulated: Annotated[
        SimulatedSettings, note("The simulated camera: what it sees, and how badly.")
    ] = SimulatedSettings()
    v4l2: Annotated[V4l2Settings, note("A camera of this machine.")] = V4l2Settings()
    stream: Annotated[StreamSettings, note("A file or a network camera.")] = StreamSettings()
    picture: Annotated[
        PictureSettings,
        note(
            "What frames show. The picture of a simulated camera has `size`, and is turned and "
            "cropped like any other; learning in simulation has no `picture`."
        ),
    ] = PictureSettings()
    publish: Annotated[PublishSettings, note("Where frames go.")] = PublishSettings()


def load(
    path: str | os.PathLike[str] | None = None, overrides: Iterable[str] = ()
) -> CameraSettings:
    """The settings in a file, or the defaults, with `KEY=VALUE` overrides.

    Raises `ConfigError` that names file, line and key.
    """
    data, sources = (
        strict_yaml.read(path, "a camera", "source: v4l2") if path is not None else ({}, {})
    )
    sources |= apply_overrides(data, overrides)
    try:
        settings = convert(without_empty_sections(data, CameraSettings), CameraSettings)
        _check(settings)
        return settings
    except Problem as problem:
        raise ConfigError(problem.located(sources)) from None


def simulated(path: str | os.PathLike[str] | None = None) -> SimulatedSettings:
    """The simulated camera in a file, or the default one.

    Raises `ConfigError` as `load` does, for a file whose source is another, and for an address.
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
    """The same for whoever asks."""
    url = settings.stream.url
    if url is None:
        return settings
    return replace(settings, stream=replace(settings.stream, url=public(url)))


def public(url: str) -> str:
    """The path of a file, or a URL without what may be a secret: user, password, and any value."""
    scheme, network, rest = url.partition("://")
    if not network:
        return url
    place, slash, path = rest.partition("/")
    return f"{scheme}://{place.rpartition('@')[2]}{slash}{_VALUE.sub('=…', path)}"


def to_yaml(settings: CameraSettings) -> str:
    """All settings, defaults included, as YAML that `load` reads back."""
    return strict_yaml.dump(msgspec.to_builtins(settings))


def _check(settings: CameraSettings) -> None:
    """Refuse values that are valid one by one but not together."""
    publish, stream = settings.publish, settings.stream
    for key, address in (("frames", publish.frames), ("requests", publish.requests)):
        if complaint := why_not_served(address):
            raise Problem(("publish", key), f"'{address}' is not valid: {complaint}")
    if publish.frames == publish.requests and not publish.frames.endswith(":0"):
        raise Problem(("publish", "requests"), f"'{publish.requests}' is that of frames already")
    if settings.source == "stream" and not stream.url:
        raise Problem(
            ("stream", "url"), "is missing: the path of a video file, or rtsp://HOST/PATH is needed"
        )
    scheme, network, _ = (stream.url or "").partition("://")
    if network and scheme not in _SCHEMES:
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
    if fishd is not None and (complaint := why_not_connected(fishd)):
        raise Problem(("simulated", "fishd"), f"'{fishd}' is not valid: {complaint}")
