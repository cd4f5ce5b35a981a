"""A camera of this machine, through V4L2: each frame with the kernel's time and number.

The kernel's API: docs.kernel.org, "Video for Linux API"; linuxpy speaks it.
"""

import errno
import os
import select
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from linuxpy.video import raw
from linuxpy.video.device import Device, Format, Frame, V4L2Error, VideoCapture

from fishd.camera.settings import V4l2Settings
from fishd.camera.sources.base import Shot, Sink, Timeline, Trouble
from fishd.camera.sources.decoding import Broken, grey
from fishd.core import text
from fishd.core.clock import boot_id
from fishd.core.schema import nearest

AGAIN = 1.0
"""Time between two tries to open the camera [s]."""
STALLED = 2.0
"""After so long without a frame it is opened anew [s]."""
BUFFERS = 4
_LOOK = 200
"""Longest time between two looks at the rest [ms]."""
_MONOTONIC, _CLOCK_MASK = 0x2000, 0xE000
_START_OF_EXPOSURE, _SOURCE_MASK = 0x10000, 0x70000
_ERROR = 0x40
_OLDEST = 2.0
"""A time stamp that is older than this, or of the future, is of another clock [s]."""
_FUTURE = 0.01
_MOST_LOST = 10_000
"""A larger gap in the numbers of frames is a counter that began anew."""
_EXPOSURE_UNIT = 1e-4
"""Of the control exposure_time_absolute [s]."""
_ARRIVAL = (
    "the driver's time stamps are not of the monotonic clock: times are those of arrival, late by "
    "what the camera takes"
)


class V4l2Source:
    """Opens the camera again whenever it is gone, stalls or fails."""

    def __init__(self, settings: V4l2Settings) -> None:
        self._settings = settings
        self.device = settings.device

    def run(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Take frames until told to stop."""
        while not stopping(0.0):
            try:
                with _opened(self._settings) as stream:
                    stream.take(sink, stopping)
            except Trouble as trouble:
                sink.trouble(trouble)
            except OSError as error:
                sink.trouble(_explained(error, self.device))
            sink.alive()
            stopping(AGAIN)


class _Stream:
    """A camera that streams."""

    def __init__(
        self,
        settings: V4l2Settings,
        capture: VideoCapture,
        found: Format,
        exposure: float | None,
        degraded: tuple[str, ...],
    ) -> None:
        """exposure: its length, where it is fixed [s]"""
        self._settings = settings
        self._capture = capture
        self._format = found
        self._exposure = exposure
        self._degraded = degraded
        self._stamped: bool | None = None
        """Do its time stamps count?"""
        self._number: int | None = None

    def take(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Until told to stop; raises `Trouble` when no frames come, and OSError."""
        waiting = select.poll()
        waiting.register(self._capture.device.fileno(), select.POLLIN)
        heard = time.monotonic()
        while not stopping(0.0):
            sink.alive()
            if events := waiting.poll(_LOOK):
                try:
                    frame = self._capture.buffer.raw_read()
                except BlockingIOError:
                    if events[0][1] & select.POLLERR:
                        raise self._stalled("reports an error") from None
                    continue
                heard = time.monotonic()
                self._use(frame, heard, sink)
            elif time.monotonic() - heard > STALLED:
                raise self._stalled(f"has sent no frame for {STALLED:g} s")

    def _stalled(self, what: str) -> Trouble:
        return Trouble(
            "stalled",
            f"{self._settings.device} {what}; it is opened anew",
            "plug it in again, into another port if that does not help; a lower v4l2.rate or size "
            "needs less of the bus",
        )

    def _use(self, frame: Frame, arrived: float, sink: Sink) -> None:
        number = frame.frame_nb
        if self._number is not None:
            lost = (number - self._number - 1) % 2**32
            if 0 < lost < _MOST_LOST:
                sink.lost(dropped=lost)
        self._number = number
        found = self._format
        try:
            if frame.buff.flags & _ERROR:
                raise Broken("the driver says so")
            picture = grey(
                frame.data, self._settings.format, found.width, found.height, found.bytes_per_line
            )
        except Broken:
            sink.lost(broken=1)
            return
        moment = self._moment(frame, arrived, sink)
        sink.put(Shot(moment, time.monotonic(), picture, self._exposure))

    def _moment(self, frame: Frame, arrived: float, sink: Sink) -> float:
        """Middle of the exposure [s, monotonic]."""
        flags, stamp = frame.buff.flags, frame.timestamp
        stamped = flags & _CLOCK_MASK == _MONOTONIC and -_FUTURE < arrived - stamp < _OLDEST
        if stamped is not self._stamped:
            self._stamped = stamped
            more = () if stamped else (_ARRIVAL,)
            sink.begin(Timeline(False, boot_id(), time.monotonic), (*self._degraded, *more))
        half = 0.5 * (self._exposure or 0.0)
        if stamped and flags & _SOURCE_MASK == _START_OF_EXPOSURE:
            half = -half
        return (stamp if stamped else arrived) - half - self._settings.delay


@contextmanager
def _opened(settings: V4l2Settings) -> Iterator[_Stream]:
    """A camera that streams as the settings say; raises `Trouble` and OSError."""
    device = Device(settings.device)
    capture = VideoCapture(device, BUFFERS)
    try:
        device.open()
        found = _set_format(capture, settings)
        degraded = _complaints(capture, settings, found)
        exposure = _set_controls(device, settings)
        capture.open()
        yield _Stream(settings, capture, found, exposure, degraded)
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
            why = f"the camera refuses {value}: {os.strerror(error.errno or 0)}"
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


def _explained(error: OSError, device: str) -> Trouble:
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
