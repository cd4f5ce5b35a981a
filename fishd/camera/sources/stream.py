"""A video file or the stream of a network camera, through OpenCV; times are those of arrival."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

# Before OpenCV is loaded: no lines of ffmpeg's on standard error.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import numpy as np

from fishd.camera.settings import StreamSettings, public
from fishd.camera.sources.base import Shot, Sink, Timeline, Trouble
from fishd.core.camera_frames import Pixels
from fishd.core.clock import boot_id

PAUSES = 1.0, 10.0
"""Shortest and longest pause before a stream is opened again [s]."""
OPENING, READING = 5.0, 3.0
"""How long opening and reading may take [s]."""
_USUAL_RATE = 30.0
"""Of a file that does not tell its own [1/s]."""
_LIVE = "times are those of arrival: a network camera does not tell when a frame was exposed"
_FILE = "times are those of playing: a file is no camera"


class StreamSource:
    """Opens the stream again whenever it ends, with growing pauses."""

    def __init__(self, settings: StreamSettings) -> None:
        assert settings.url is not None
        self._settings = settings
        self._url = settings.url
        self._live = "://" in settings.url
        if self._live:  # a file would lose its first frame
            os.environ.setdefault(
                "OPENCV_FFMPEG_CAPTURE_OPTIONS", "rtsp_transport;tcp|fflags;nobuffer"
            )
        self.device = public(settings.url)

    def run(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Take frames until told to stop."""
        pause = PAUSES[0]
        while not stopping(0.0):
            begun = time.monotonic()
            try:
                self._play(sink, stopping)
            except Trouble as trouble:
                sink.trouble(trouble)
                while trouble.condition == "ended" and not stopping(PAUSES[0]):
                    sink.alive()
            if time.monotonic() - begun > OPENING + PAUSES[1]:
                pause = PAUSES[0]
            waited = time.monotonic()
            while time.monotonic() - waited < pause and not stopping(0.5):
                sink.alive()
            pause = min(2.0 * pause, PAUSES[1])

    def _play(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """One connection, or a file for as long as it is played; raises `Trouble`."""
        if not self._live and not Path(self._url).is_file():
            raise Trouble("unplugged", f"{self.device}: no such file", "set stream.url")
        sink.alive()
        with _opened(self._url) as capture:
            if not capture.isOpened():
                raise self._closed()
            sink.begin(
                Timeline(False, boot_id(), time.monotonic), (_LIVE if self._live else _FILE,)
            )
            own = capture.get(cv2.CAP_PROP_FPS)
            rate = self._settings.rate or (own if 0.0 < own <= 1000.0 else _USUAL_RATE)
            due, played = time.monotonic(), 0
            while not stopping(0.0):
                sink.alive()
                found, picture = capture.read()
                if not found:
                    self._end(played)
                    capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
                    played = 0
                    continue
                played += 1
                if not self._live:
                    due = max(due + 1.0 / rate, time.monotonic() - 1.0)
                    if stopping(max(0.0, due - time.monotonic())):
                        return
                now = time.monotonic()
                grey = _grey(np.asarray(picture, np.uint8))
                sink.put(Shot(now - self._settings.delay, time.monotonic(), grey))

    def _end(self, played: int) -> None:
        """There is no further frame: raises `Trouble` unless the file is to be played again."""
        if self._live:
            raise Trouble(
                "stalled",
                f"{self.device} has ended, or sent nothing for {READING:g} s; it is opened anew",
                "is the camera on, and its network?",
            )
        if not played:
            raise Trouble(
                "unusable", f"{self.device}: no frame in it can be read", "give a video file"
            )
        if not self._settings.loop:
            raise Trouble("ended", f"{self.device} has been played", "stream.loop: true repeats it")

    def _closed(self) -> Trouble:
        if self._live:
            return Trouble(
                "unplugged",
                f"{self.device} cannot be opened",
                "is the camera on, and are address, user and password right? "
                "'ffprobe URL' says more",
            )
        return Trouble("unusable", f"{self.device}: it is no video", "give a video file")


@contextmanager
def _opened(url: str) -> Iterator[cv2.VideoCapture]:
    capture = cv2.VideoCapture(
        url,
        cv2.CAP_FFMPEG,
        [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            round(OPENING * 1e3),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            round(READING * 1e3),
        ],
    )
    try:
        yield capture
    finally:
        capture.release()


def _grey(picture: Pixels) -> Pixels:
    if picture.ndim == 2:
        return picture
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
