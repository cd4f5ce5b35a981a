"""Opening of a V4L2 camera with its settings, and explanations of the kernel's errors."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

from linuxpy.video import raw
from linuxpy.video.device import Device, Format, V4L2Error, VideoCapture

from fishd.camera.settings import V4l2Settings
from fishd.camera.sources.base import Trouble
from fishd.core import text
from fishd.core.schema import suggest

BUFFERS = 4
"""Number of frames that the kernel can hold."""
_EXPOSURE_UNIT_S = 1e-4
"""Unit of the control exposure_time_absolute [s]."""


class OpenCamera(NamedTuple):
    """Open camera that streams."""

    capture: VideoCapture
    format: Format
    exposure: float | None
    """Exposure time, where it is fixed [s]."""
    limitations: tuple[str, ...]
    """Differences between the camera's behaviour and its settings."""


@contextmanager
def open_camera(settings: V4l2Settings) -> Iterator[OpenCamera]:
    """Open a camera with its settings, and close it at the end; raises `Trouble` and OSError."""
    device = Device(settings.device)
    capture = VideoCapture(device, BUFFERS)
    try:
        device.open()
        camera_format = _set_format(capture, settings)
        limitations = _set_rate_and_compare(capture, settings, camera_format)
        exposure = _set_controls(device, settings)
        capture.open()
        yield OpenCamera(capture, camera_format, exposure, limitations)
    except V4L2Error as error:
        raise _no_camera(settings.device, text.error_message(error)) from None
    finally:
        _close(device, capture)


def _close(device: Device, capture: VideoCapture) -> None:
    """Release the device and its buffers, in any state of the camera."""
    memory = capture.buffer
    with suppress(OSError, ValueError):
        capture.close()
    for item in getattr(memory, "buffers", None) or ():
        with suppress(OSError, ValueError):
            item.close()
    with suppress(OSError):
        device.close()


def _set_format(capture: VideoCapture, settings: V4l2Settings) -> Format:
    try:
        capture.set_format(settings.width, settings.height, settings.format)
        camera_format: Format = capture.get_format()
        format_name = camera_format.pixel_format.human_str()
    except ValueError:  # a format that linuxpy does not know
        format_name = "another format"
    except OSError as error:
        if error.errno == errno.ENOTTY:
            raise _no_camera(settings.device, "it is not a video device") from None
        if error.errno == errno.EINVAL:
            raise _no_camera(settings.device, "it takes no pictures") from None
        raise
    if format_name != settings.format:
        offered = ", ".join(_formats(capture)) or format_name
        raise Trouble(
            "unusable",
            f"{settings.device} does not send {settings.format}",
            f"set v4l2.format to one of MJPG, YUYV, GREY that it sends: {offered}",
        )
    return camera_format


def _formats(capture: VideoCapture) -> list[str]:
    with suppress(OSError, ValueError):
        return [item.pixel_format.human_str() for item in capture.formats()]
    return []


def _set_rate_and_compare(
    capture: VideoCapture, settings: V4l2Settings, camera_format: Format
) -> tuple[str, ...]:
    """Set the rate, and return the differences between the camera and its settings."""
    differences = []
    if (camera_format.width, camera_format.height) != (settings.width, settings.height):
        differences.append(
            f"its pictures are {camera_format.width} x {camera_format.height} px: it does "
            f"not support {settings.width} x {settings.height}"
        )
    rate = None
    with suppress(OSError, ZeroDivisionError):
        capture.set_fps(settings.rate)
        rate = float(capture.get_fps())
    if rate is None:
        differences.append("its rate cannot be set")
    elif abs(rate - settings.rate) > 0.01 * settings.rate:
        differences.append(f"it takes {rate:g} frames a second, not {settings.rate:g}")
    return tuple(differences)


def _set_controls(device: Device, settings: V4l2Settings) -> float | None:
    """Set the controls of the settings in their order; return the exposure time where fixed [s]."""
    controls = {item.config_name: item for item in device.controls.values()}
    for name, value in settings.controls.items():
        control = controls.get(name)
        if control is None:
            raise _bad_control(settings, name, f"there is none; {suggest(name, list(controls))}")
        if not control.minimum <= value <= control.maximum:
            range_text = f"{control.minimum} to {control.maximum} is needed"
            raise _bad_control(settings, name, f"{value} is not valid: {range_text}")
        try:
            control.value = int(value)
        except (AttributeError, ValueError) as error:
            raise _bad_control(settings, name, text.error_message(error)) from None
        except OSError as error:
            if error.errno == errno.ENODEV:
                raise
            why = f"the camera refuses {value}: {error.strerror}"
            raise _bad_control(settings, name, why) from None
    with suppress(KeyError, OSError):
        automatic = controls["auto_exposure"].value
        if automatic in (raw.ExposureAutoType.MANUAL, raw.ExposureAutoType.SHUTTER_PRIORITY):
            return float(controls["exposure_time_absolute"].value) * _EXPOSURE_UNIT_S
    return None


def _bad_control(settings: V4l2Settings, name: str, why: str) -> Trouble:
    return Trouble(
        "unusable",
        f"v4l2.controls.{name}: {why}",
        f"'v4l2-ctl -d {settings.device} --list-ctrls' lists the controls; some depend on others "
        "that must be set first, such as exposure_time_absolute on auto_exposure",
    )


def _no_camera(device: str, why: str) -> Trouble:
    return Trouble(
        "unusable",
        f"{device}: {why}",
        "'v4l2-ctl --list-devices' lists cameras; a web camera's second device takes no pictures",
    )


def explain_error(error: OSError, device: str) -> Trouble:
    """Return an explanation of the kernel's error."""
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
            "close that program, such as a video call or another fishd-camera",
        )
    if number == errno.ENOSPC:
        return Trouble(
            "unusable",
            f"{device}: the USB bus has no room for it",
            "choose a smaller size or rate, MJPG, or a separate USB port",
        )
    if number == errno.ENOTTY:
        return _no_camera(device, "it is not a video device")
    return Trouble(
        "stalled",
        f"{device}: {error.strerror or text.error_message(error)}; it is opened again",
        "plug it in again, into another port if that does not help",
    )
