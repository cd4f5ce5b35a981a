"""A camera of this machine, through V4L2: each frame with the kernel's time and number.

The kernel's API: docs.kernel.org, "Video for Linux API"; linuxpy speaks it.
"""

import select
import time
from collections.abc import Callable

from linuxpy.video.device import Frame

from fishd.camera.settings import V4l2Settings
from fishd.camera.sources.base import Shot, Sink, Timeline, Trouble
from fishd.camera.sources.decoding import Broken, grey
from fishd.camera.sources.v4l2_device import BUFFERS, OpenCamera, explained, opened
from fishd.core.clock import boot_id

AGAIN = 1.0
"""Time between two tries to open the camera [s]."""
STALLED = 2.0
"""After so long without a whole frame it is opened anew [s]."""
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
                with opened(self._settings) as camera:
                    _Stream(self._settings, camera).take(sink, stopping)
            except Trouble as trouble:
                sink.trouble(trouble)
            except OSError as error:
                sink.trouble(explained(error, self.device))
            sink.alive()
            stopping(AGAIN)


class _Stream:
    """A camera that streams."""

    def __init__(self, settings: V4l2Settings, camera: OpenCamera) -> None:
        self._settings = settings
        self._capture, self._format, self._exposure, self._degraded = camera
        self._stamped: bool | None = None
        """Do its time stamps count?"""
        self._late = 0
        """Frames in a row that were too old."""
        self._number: int | None = None

    def take(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Until told to stop; raises `Trouble` when no frames come, and OSError."""
        waiting = select.poll()
        waiting.register(self._capture.device.fileno(), select.POLLIN)
        whole = heard = time.monotonic()
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
                if broken := self._use(frame, heard, sink):
                    if heard - whole > STALLED:
                        raise self._only_broken(broken)
                else:
                    whole = heard
            elif time.monotonic() - heard > STALLED:
                raise self._stalled(f"has sent no frame for {STALLED:g} s")

    def _stalled(self, what: str) -> Trouble:
        return Trouble(
            "stalled",
            f"{self._settings.device} {what}; it is opened anew",
            "plug it in again, into another port if that does not help; a lower v4l2.rate or size "
            "needs less of the bus",
        )

    def _only_broken(self, why: Broken) -> Trouble:
        return Trouble(
            "stalled",
            f"{self._settings.device} has sent only broken frames for {STALLED:g} s ({why}); it is "
            "opened anew",
            "another cable or port, without a hub; a lower v4l2.rate or size; another v4l2.format: "
            "'v4l2-ctl --list-formats-ext' shows what it sends",
        )

    def _use(self, frame: Frame, arrived: float, sink: Sink) -> Broken | None:
        """Pass it on; why it is broken, where it is."""
        number = frame.frame_nb
        if self._number is not None:
            lost = (number - self._number - 1) % 2**32
            if 0 < lost < _MOST_LOST:
                sink.lost(dropped=lost)
        self._number = number
        if self._is_late(frame, arrived):
            sink.lost(dropped=1)
            return None
        found = self._format
        try:
            if frame.buff.flags & _ERROR:
                raise Broken("the driver says so")
            picture = grey(
                frame.data, self._settings.format, found.width, found.height, found.bytes_per_line
            )
        except Broken as broken:
            sink.lost(broken=1)
            return broken
        moment = self._moment(frame, arrived, sink)
        sink.put(Shot(moment, time.monotonic(), picture, self._exposure))
        return None

    def _is_late(self, frame: Frame, arrived: float) -> bool:
        """Did it wait in the driver while this process stood still?

        No more can wait than the driver holds: if all that come are as old, it is another clock.
        """
        late = (
            self._stamped is True
            and frame.buff.flags & _CLOCK_MASK == _MONOTONIC
            and arrived - frame.timestamp >= _OLDEST
            and self._late < BUFFERS
        )
        self._late = self._late + 1 if late else 0
        return late

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
