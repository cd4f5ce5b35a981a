"""Pictures of a video file with their times, and learning of the tail that it shows."""

import itertools
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Self

# They must be set before OpenCV is loaded and opens a file. A file may name others as its parts.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "protocol_whitelist;file")

import cv2

from fishd.camera.picture import rotate, turn_read_out
from fishd.camera.sources.stream import to_grey
from fishd.camera.tail.learned import Learned
from fishd.camera.tail.learner import CannotLearn, Learner
from fishd.camera.tail.lens import Lens, Turn
from fishd.core import files, text
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError

LEARN_S = 20.0
"""Length of the part of a video from which the tail is learned [s]."""
_MAX_RATE_HZ = 10_000.0
_STREAM_BEGINS = b"\xff\xd8", b"\0\0\1", b"\0\0\0\1"
"""First bytes of JPEG, H.264 and H.265 pictures in a row, without a container that has times."""
_PROGRAM_STREAM_BEGINS = b"\0\0\1\xba"


class CannotReadVideo(FishdError, ValueError):
    """A file is not a video that can be read, or its pictures have no times."""


class VideoPicture(NamedTuple):
    """One picture of a video."""

    number: int
    """Number of the picture, from 0."""
    time: float
    """Time in the video [s]."""
    pixels: Pixels
    """Turned grey picture."""


class Video:
    """Video file; a context manager. Each call of `pictures` reads it from its begin."""

    def __init__(
        self, path: Path, rate: float | None = None, turn: Turn = 0, read_out: float = 0.0
    ) -> None:
        """
        rate: pictures a second; None for the times that the file states
        turn: rotation after which the fish's head is at the left
        read_out: time from the exposure of a picture's first row to that of its last one [s]

        Raises `CannotReadVideo`.
        """
        self.path, self.shown = path, text.quoted(str(path))
        self._turn = turn
        head = self._read_head()
        self._capture = self._open()
        width, height, stated, count = (
            self._capture.get(name)
            for name in (
                cv2.CAP_PROP_FRAME_WIDTH,
                cv2.CAP_PROP_FRAME_HEIGHT,
                cv2.CAP_PROP_FPS,
                cv2.CAP_PROP_FRAME_COUNT,
            )
        )
        size = round(width), round(height)
        self.size = size if turn % 180 == 0 else size[::-1]
        """Width and height of the turned picture [px]."""
        self.count = max(0, round(min(count, 1e9)))
        """Number of pictures as the file states it; 0 if it does not."""
        self._has_times = rate is None
        is_stream = head.startswith(_STREAM_BEGINS) and head != _PROGRAM_STREAM_BEGINS
        if rate is None and (is_stream or not 0.0 < stated <= _MAX_RATE_HZ):
            raise CannotReadVideo(
                f"{self.shown} does not state when its pictures were taken: give their rate, such "
                "as --rate 30"
            )
        self.rate = rate or stated
        if read_out * self.rate > 1.0:
            raise CannotReadVideo(
                f"{self.shown}: --read-out must not exceed {1e3 / self.rate:.4g} ms, the time from "
                "one picture to the next"
            )
        self.read_out = turn_read_out(read_out, self._turn)
        """Time from the first row to the last one of a turned picture, and of its columns [s]."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._capture.release()

    def _read_head(self) -> bytes:
        try:
            status = self.path.stat()
            head = b""
            if stat.S_ISREG(status.st_mode):
                with self.path.open("rb") as file:
                    head = file.read(4)
        except OSError as error:
            raise CannotReadVideo(f"{self.shown} cannot be read: {error.strerror}") from None
        if not head:
            kind = "empty" if stat.S_ISREG(status.st_mode) else files.describe_kind(status)
            raise CannotReadVideo(f"{self.shown} is {kind}: give a video file")
        return head

    def _open(self) -> cv2.VideoCapture:
        cv2.utils.logging.setLogLevel(0)  # it prints lines about a file that is not a video
        capture = cv2.VideoCapture(str(self.path.absolute()), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise CannotReadVideo(
                f"{self.shown} is not a video, or has a codec that OpenCV cannot read: convert it, "
                "for example with ffmpeg, to MP4 with H.264"
            )
        return capture

    def pictures(self, begin: int = 0) -> Iterator[VideoPicture]:
        """Yield the pictures from number `begin`; raise `CannotReadVideo` if there are none."""
        self._capture.release()
        self._capture = self._open()
        number, latest = 0, -1.0
        while self._capture.grab():
            number += 1
            if number <= begin:
                continue
            success, picture = self._capture.retrieve()
            if not success:
                break
            time = (number - 1) / self.rate
            if self._has_times:
                time = 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC)
                if time <= latest:
                    raise CannotReadVideo(
                        f"{self.shown}: the time of picture {number} is not after that of the one "
                        "before: give the rate of its pictures, such as --rate 30"
                    )
                latest = time
            yield VideoPicture(number - 1, time, rotate(to_grey(picture), self._turn))
        if not number:
            raise CannotReadVideo(f"{self.shown} contains no picture that can be read")


def learn(video: Video, lens: Lens | None = None) -> tuple[Learned, float]:
    """Return what a video shows of the tail, and where the part begins that shows it [s].

    That is the first part of 20 s in which the fish swims.
    Raises `CannotLearn` for the first part if no part shows it, and `CannotReadVideo`.
    """
    learner, begin = Learner(lens), 0.0
    problem: CannotLearn | None = None
    for picture in itertools.chain(video.pictures(), [None]):
        if picture is None or picture.time - begin >= LEARN_S:
            try:
                return learner.finish(), begin
            except CannotLearn as error:
                problem = problem or error
        if picture is not None:
            if picture.time - begin >= LEARN_S:
                learner, begin = Learner(lens), picture.time
            learner.add(picture.time, picture.pixels)
    raise CannotLearn(f"{video.shown}: {problem}")
