"""Camera of this machine, read through V4L2: each frame has the kernel's time stamp and number.

The kernel's API is described at docs.kernel.org, "Video for Linux API"; linuxpy implements it.
"""

import select
import time
from collections.abc import Callable

import numpy as np
import simplejpeg
from linuxpy.video.device import Frame

from fishd.camera.settings import V4l2Settings
from fishd.camera.sources.base import Shot, Sink, Timeline, Trouble
from fishd.camera.sources.v4l2_device import BUFFERS, OpenCamera, explain_error, open_camera
from fishd.core.camera_frames import Pixels
from fishd.core.clock import read_boot_id

RETRY_PERIOD_S = 1.0
"""Time between two attempts to open the camera [s]."""
STALL_TIMEOUT_S = 2.0
"""Time without a complete frame after which the camera is opened again [s]."""
_POLL_TIMEOUT_MS = 200
"""Longest wait for a frame between two checks of `stopping` [ms]."""
_MONOTONIC, _CLOCK_MASK = 0x2000, 0xE000
_START_OF_EXPOSURE, _SOURCE_MASK = 0x10000, 0x70000
_ERROR = 0x40
_MAX_AGE_S = 2.0
"""Largest age of a valid time stamp; an older one belongs to another clock [s]."""
_MAX_LEAD_S = 0.01
"""Largest lead of a valid time stamp over the current time [s]."""
_MAX_LOST_FRAMES = 10_000
"""Largest gap in the numbers of frames; a larger one is a counter that was reset."""
_ARRIVAL = (
    "the driver's time stamps are not those of the monotonic clock: times are those of arrival, "
    "which include the camera's delay"
)


class Broken(ValueError):
    """A frame cannot be decoded."""


class V4l2Source:
    """Source that opens the camera again whenever it is unplugged, stalls or fails."""

    def __init__(self, settings: V4l2Settings) -> None:
        self._settings = settings
        self.device = settings.device

    def run(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Read frames until `stopping` returns true."""
        while not stopping(0.0):
            try:
                with open_camera(self._settings) as camera:
                    _Stream(self._settings, camera).run(sink, stopping)
            except Trouble as trouble:
                sink.trouble(trouble)
            except OSError as error:
                sink.trouble(explain_error(error, self.device))
            sink.alive()
            stopping(RETRY_PERIOD_S)


class _Stream:
    """Open camera that streams."""

    def __init__(self, settings: V4l2Settings, camera: OpenCamera) -> None:
        self._settings = settings
        self._capture, self._format, self._exposure, self._degraded = camera
        self._has_valid_stamp: bool | None = None
        """Whether the driver's time stamps are used; None before the first frame."""
        self._late_count = 0
        """Number of consecutive frames that were too old."""
        self._number: int | None = None

    def run(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Read frames until `stopping` returns true; raises `Trouble` and OSError."""
        waiting = select.poll()
        waiting.register(self._capture.device.fileno(), select.POLLIN)
        last_complete = last_arrival = time.monotonic()
        while not stopping(0.0):
            sink.alive()
            if events := waiting.poll(_POLL_TIMEOUT_MS):
                try:
                    frame = self._capture.buffer.raw_read()
                except BlockingIOError:
                    if events[0][1] & select.POLLERR:
                        raise self._stalled("reports an error") from None
                    continue
                last_arrival = time.monotonic()
                if broken := self._put_frame(frame, last_arrival, sink):
                    if last_arrival - last_complete > STALL_TIMEOUT_S:
                        raise self._only_broken(broken)
                else:
                    last_complete = last_arrival
            elif time.monotonic() - last_arrival > STALL_TIMEOUT_S:
                raise self._stalled(f"has sent no frame for {STALL_TIMEOUT_S:g} s")

    def _stalled(self, symptom: str) -> Trouble:
        return Trouble(
            "stalled",
            f"{self._settings.device} {symptom}; it is opened again",
            "plug it in again, into another port if that does not help; a lower v4l2.rate or size "
            "needs less bandwidth",
        )

    def _only_broken(self, error: Broken) -> Trouble:
        return Trouble(
            "stalled",
            f"{self._settings.device} has sent only broken frames for {STALL_TIMEOUT_S:g} s "
            f"({error}); it is opened again",
            "try another cable or port, without a hub, a lower v4l2.rate or size, or another "
            "v4l2.format: 'v4l2-ctl --list-formats-ext' lists its formats",
        )

    def _put_frame(self, frame: Frame, arrived: float, sink: Sink) -> Broken | None:
        """Put a frame; return the error where it is broken."""
        number = frame.frame_nb
        if self._number is not None:
            lost = (number - self._number - 1) % 2**32
            if 0 < lost < _MAX_LOST_FRAMES:
                sink.lost(dropped=lost)
        self._number = number
        if self._is_late(frame, arrived):
            sink.lost(dropped=1)
            return None
        size = self._format.width, self._format.height, self._format.bytes_per_line
        try:
            if frame.buff.flags & _ERROR:
                raise Broken("the driver reports an error")
            picture = decode_grey(frame.data, self._settings.format, *size)
        except Broken as broken:
            sink.lost(broken=1)
            return broken
        moment = self._exposure_middle(frame, arrived, sink)
        sink.put(Shot(moment, time.monotonic(), picture, self._exposure))
        return None

    def _is_late(self, frame: Frame, arrived: float) -> bool:
        """Return whether a frame waited in the driver while this process was stopped.

        At most `BUFFERS` frames can wait there; when more are old, the clock is another one.
        """
        is_late = (
            self._has_valid_stamp is True
            and frame.buff.flags & _CLOCK_MASK == _MONOTONIC
            and arrived - frame.timestamp >= _MAX_AGE_S
            and self._late_count < BUFFERS
        )
        self._late_count = self._late_count + 1 if is_late else 0
        return is_late

    def _exposure_middle(self, frame: Frame, arrived: float, sink: Sink) -> float:
        """Return the middle of the exposure [s, monotonic clock]."""
        flags, stamp = frame.buff.flags, frame.timestamp
        has_valid_stamp = (
            flags & _CLOCK_MASK == _MONOTONIC and -_MAX_LEAD_S < arrived - stamp < _MAX_AGE_S
        )
        if has_valid_stamp is not self._has_valid_stamp:
            self._has_valid_stamp = has_valid_stamp
            arrival_note = () if has_valid_stamp else (_ARRIVAL,)
            sink.begin(
                Timeline(False, read_boot_id(), time.monotonic), (*self._degraded, *arrival_note)
            )
        half = 0.5 * (self._exposure or 0.0)
        if has_valid_stamp and flags & _SOURCE_MASK == _START_OF_EXPOSURE:
            half = -half
        return (stamp if has_valid_stamp else arrived) - half - self._settings.delay


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
