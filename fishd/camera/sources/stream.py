"""Video file or stream of a network camera, read by OpenCV; times are those of arrival."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

# This must be set before OpenCV is loaded; it keeps ffmpeg's lines off standard error.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import numpy as np

from fishd.camera.settings import StreamSettings, hide_secrets
from fishd.camera.sources.base import Shot, Sink, Timeline, Trouble
from fishd.core.camera_frames import Pixels
from fishd.core.clock import read_boot_id

PAUSES = 1.0, 10.0
"""Shortest and longest pause before a stream is opened again [s]."""
OPEN_TIMEOUT_S, READ_TIMEOUT_S = 5.0, 3.0
"""Longest time that opening and reading may take [s]."""
_DEFAULT_RATE = 30.0
"""Frame rate of a file that does not state its rate [1/s]."""
_LIVE = "times are those of arrival: a network camera does not send the times of exposure"
_FILE = "times are those of playback: a file has no times of exposure"


class StreamSource:
    """Source that opens the stream again whenever it ends, after increasing pauses."""

    def __init__(self, settings: StreamSettings) -> None:
        assert settings.url is not None
        self._settings = settings
        self._url = settings.url
        self._live = "://" in settings.url
        if self._live:  # a file would lose its first frame
            os.environ.setdefault(
                "OPENCV_FFMPEG_CAPTURE_OPTIONS", "rtsp_transport;tcp|fflags;nobuffer"
            )
        self.device = hide_secrets(settings.url)

    def run(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Read frames until `stopping` returns true."""
        pause = PAUSES[0]
        while not stopping(0.0):
            start = time.monotonic()
            try:
                self._play(sink, stopping)
            except Trouble as trouble:
                sink.trouble(trouble)
                while trouble.condition == "ended" and not stopping(PAUSES[0]):
                    sink.alive()
            if time.monotonic() - start > OPEN_TIMEOUT_S + PAUSES[1]:
                pause = PAUSES[0]
            pause_start = time.monotonic()
            while time.monotonic() - pause_start < pause and not stopping(0.5):
                sink.alive()
            pause = min(2.0 * pause, PAUSES[1])

    def _play(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Read frames from one connection, or from a file to its end; raises `Trouble`."""
        if not self._live and not Path(self._url).is_file():
            raise Trouble("unplugged", f"{self.device}: no such file", "set stream.url")
        sink.alive()
        with _open(self._url) as capture:
            if not capture.isOpened():
                raise self._open_failure()
            sink.begin(
                Timeline(False, read_boot_id(), time.monotonic), (_LIVE if self._live else _FILE,)
            )
            stated_rate = capture.get(cv2.CAP_PROP_FPS)
            rate = self._settings.rate or (
                stated_rate if 0.0 < stated_rate <= 1000.0 else _DEFAULT_RATE
            )
            due, frame_count = time.monotonic(), 0
            while not stopping(0.0):
                sink.alive()
                success, picture = capture.read()
                if not success:
                    self._handle_end(frame_count)
                    capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
                    frame_count = 0
                    continue
                frame_count += 1
                if not self._live:
                    due = max(due + 1.0 / rate, time.monotonic() - 1.0)
                    if stopping(max(0.0, due - time.monotonic())):
                        return
                now = time.monotonic()
                sink.put(Shot(now - self._settings.delay, time.monotonic(), to_grey(picture)))

    def _handle_end(self, frame_count: int) -> None:
        """Handle the end of the frames: raise `Trouble` unless a file is to be repeated."""
        if self._live:
            raise Trouble(
                "stalled",
                f"{self.device} has ended, or sent nothing for {READ_TIMEOUT_S:g} s; it is "
                "opened again",
                "check that the camera and its network are on",
            )
        if not frame_count:
            raise Trouble(
                "unusable", f"{self.device}: its frames cannot be read", "give a video file"
            )
        if not self._settings.loop:
            raise Trouble(
                "ended", f"{self.device} is at its end", "set stream.loop: true to repeat it"
            )

    def _open_failure(self) -> Trouble:
        if self._live:
            return Trouble(
                "unplugged",
                f"{self.device} cannot be opened",
                "check that the camera is on, and address, user and password; "
                "'ffprobe URL' shows details",
            )
        return Trouble("unusable", f"{self.device} is not a video", "give a video file")


@contextmanager
def _open(url: str) -> Iterator[cv2.VideoCapture]:
    capture = cv2.VideoCapture(
        url,
        cv2.CAP_FFMPEG,
        [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            round(OPEN_TIMEOUT_S * 1e3),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            round(READ_TIMEOUT_S * 1e3),
        ],
    )
    try:
        yield capture
    finally:
        capture.release()


def to_grey(picture: object) -> Pixels:
    """Return the grey levels of a picture of OpenCV."""
    pixels = np.asarray(picture, np.uint8)
    if pixels.ndim == 2:
        return pixels
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)
