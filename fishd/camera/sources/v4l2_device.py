"""Opens a V4L2 camera as the settings say, and puts the kernel's errors into words."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

from linuxpy.video import raw
from linuxpy.video.device import Device, Format, V4L2Error, VideoCapture

from fishd.camera.settings import V4l2Settings
from fishd.camera.sources.base import Trouble
from fishd.core import text
from fishd.core.schema import nearest

BUFFERS = 4
"""Frames that the kernel can hold."""
_EXPOSURE_UNIT = 1e-4
"""Of the control exposure_time_absolute [s]."""


class OpenCamera(NamedTuple):
    """A camera that streams."""

    capture: VideoCapture
    format: Format
    exposure: float | None
    """Its length, where it is fixed [s]."""
    degraded: tuple[str, ...]
    """What it does in another way than the settings say."""


@contextmanager
def opened(settings: V4l2Settings) -> Iterator[OpenCamera]:
    """A camera that streams as the settings say; raises `Trouble` and OSError."""
    device = Device(settings.device)
    capture = VideoCapture(device, BUFFERS)
    try:
        device.open()
        found = _set_format(capture, settings)
        degraded = _complaints(capture, settings, found)
        exposure = _set_controls(device, settings)
        capture.open()
        yield OpenCamera(capture, found, exposure, degraded)
    except V4L2Error as error:
        raise _no_camera(settings.device, text.said(error)) from None
    finally:
        _close(device, capture)


def _close(device: Device, capture: VideoCapture) -> None:
    """Let go of everything, whatever state the camera is in."""
    memory = capture.buffer
    with suppress(OSError, ValueError):
        capture.close()
    for each in getattr(memory, "buffers", None) or ():
        with suppress(OSError, ValueError):
            each.close()
    with suppress(OSError):
        device.close()


def _set_format(capture: VideoCapture, settings: V4l2Settings) -> Format:
    try:
        capture.set_format(settings.width, settings.height, settings.format)
        found: Format = capture.get_format()
        sends = found.pixel_format.human_str()
    except ValueError:  # a format that linuxpy does not know
        sends = "another format"
    except OSError as error:
        if error.errno == errno.ENOTTY:
            raise _no_camera(settings.device, "it is no video device") from None
        if error.errno == errno.EINVAL:
            raise _no_camera(settings.device, "it takes no pictures") from None
        raise
    if sends != settings.format:
        offered = ", ".join(_formats(capture)) or sends
        raise Trouble(
            "unusable",
            f"{settings.device} does not send {settings.format}",
            f"set v4l2.format to one of MJPG, YUYV, GREY that it sends: {offered}",
        )
    return found


def _formats(capture: VideoCapture) -> list[str]:
    with suppress(OSError, ValueError):
        return [each.pixel_format.human_str() for each in capture.formats()]
    return []


def _complaints(capture: VideoCapture, settings: V4l2Settings, found: Format) -> tuple[str, ...]:
    """What the camera does in another way than the settings say."""
    complaints = []
    if (found.width, found.height) != (settings.width, settings.height):
        complaints.append(
            f"its pictures are {found.width} x {found.height} px: it has none of "
            f"{settings.width} x {settings.height}"
        )
    rate = None
    with suppress(OSError, ZeroDivisionError):
        capture.set_fps(settings.rate)
        rate = float(capture.get_fps())
    if rate is None:
        complaints.append("its rate cannot be set")
    elif abs(rate - settings.rate) > 0.01 * settings.rate:
        complaints.append(f"it takes {rate:g} frames a second, not {settings.rate:g}")
    return tuple(complaints)


def _set_controls(device: Device, settings: V4l2Settings) -> float | None:
    """Set what the settings name, in their order; the exposure, where it is fixed [s]."""
    controls = {each.config_name: each for each in device.controls.values()}
    for name, value in settings.controls.items():
        control = controls.get(name)
        if control is None:
            raise _bad_control(settings, name, f"there is none; {nearest(name, list(controls))}")
        if not control.minimum <= value <= control.maximum:
            permitted = f"{control.minimum} to {control.maximum} is needed"
            raise _bad_control(settings, name, f"{value} is not valid: {permitted}")
        try:
            control.value = int(value)
        except (AttributeError, ValueError) as error:
            raise _bad_control(settings, name, text.said(error)) from None
        except OSError as error:
            if error.errno == errno.ENODEV:
                raise
            why = f"the camera refuses {value}: {error.strerror}"
            raise _bad_control(settings, name, why) from None
    with suppress(KeyError, OSError):
        automatic = controls["auto_exposure"].value
        if automatic in (raw.ExposureAutoType.MANUAL, raw.ExposureAutoType.SHUTTER_PRIORITY):
            return float(controls["exposure_time_absolute"].value) * _EXPOSURE_UNIT
    return None


def _bad_control(settings: V4l2Settings, name: str, why: str) -> Trouble:
    return Trouble(
        "unusable",
        f"v4l2.controls.{name}: {why}",
        f"'v4l2-ctl -d {settings.device} --list-ctrls' shows them; some follow from others that "
        "have to be set first, as exposure_time_absolute from auto_exposure",
    )


def _no_camera(device: str, why: str) -> Trouble:
    return Trouble(
        "unusable",
        f"{device}: {why}",
        "'v4l2-ctl --list-devices' lists cameras; a web camera's second device takes no pictures",
    )


def explained(error: OSError, device: str) -> Trouble:
    """An error of the kernel in words."""
    number = error.errno
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOTDIR):
        return Trouble(
            "unplugged",
            f"{device}: there is no such camera",
            "plug it in; 'v4l2-ctl --list-devices' lists cameras, and v4l2.device names one",
        )
    if number in (errno.EACCES, errno.EPERM):
        return Trouble(
            "unusable",
            f"{device}: this user may not open it",
            "'sudo usermod -aG video USER', then log in again",
        )
    if number == errno.EBUSY:
        return Trouble(
            "unusable",
            f"{device}: another program uses it",
            "end that, such as a video call or another fishd-camera",
        )
    if number == errno.ENOSPC:
        return Trouble(
            "unusable",
            f"{device}: the USB bus has no room for it",
            "choose a smaller size or rate, MJPG, or a port of its own",
        )
    if number == errno.ENOTTY:
        return _no_camera(device, "it is no video device")
    return Trouble(
        "stalled",
        f"{device}: {error.strerror or text.said(error)}; it is opened anew",
        "plug it in again, into another port if that does not help",
    )
