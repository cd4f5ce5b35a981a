"""Videos of filmed tails, and of fish that swim by themselves."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rigs.filmed_tail import FilmedTail


def write_video(path: Path, pictures: Iterable[NDArray[np.uint8]], rate: float) -> Path:
    """Write a video of JPEG pictures, which each build of OpenCV can write."""
    writer = None
    for picture in pictures:
        if writer is None:
            size, code = picture.shape[1::-1], cv2.VideoWriter.fourcc(*"MJPG")
            writer = cv2.VideoWriter(str(path), code, rate, size, isColor=picture.ndim == 3)
        writer.write(picture)
    assert writer
    writer.release()
    return path


def film_video(path: Path, camera: FilmedTail, begin: float, end: float) -> Path:
    """Write the pictures of a camera from one time to another [s]."""
    pictures = (shot.picture for shot in camera.shots(begin, end))
    return write_video(path, pictures, camera.film.rate)


@dataclass(frozen=True)
class FilmedFish:
    """A fish that swims by itself on a curve, from above; lengths are in pixels."""

    width: int = 400
    height: int = 240
    speed: float = 60.0
    begin: tuple[float, float] = (60.0, 90.0)
    """Column and row of its place at first."""
    turn: float = 0.1
    """Rate of its heading, anticlockwise [rad/s]."""
    frequency: float = 2.5
    swing: float = 8.0
    """Amplitude of the tip of its tail."""
    length: float = 60.0
    tag: int | None = None
    water: float = 190.0
    body: float = 60.0

    def heading(self, time: float) -> float:
        return 0.15 - self.turn * time

    def place(self, time: float) -> NDArray[np.float64]:
        h = self.heading(np.linspace(0.0, time, 60))  # type: ignore[arg-type]
        ahead = np.stack([np.cos(h), np.sin(h)], axis=1).mean(axis=0)
        return np.array(self.begin) + self.speed * time * ahead

    def _outline(self, time: float) -> NDArray[np.float64]:
        """Return the outline with the head to the right."""
        s = np.linspace(0.0, 1.0, 40)
        y = self.swing * np.clip(s - 0.3, 0.0, None) ** 2 / 0.49
        y *= np.sin(math.tau * self.frequency * time - 2.0 * s)
        half = 0.12 * self.length * np.sqrt(4.0 * s) * np.clip(1.0 - s, 0.12, 1.0) ** 0.8
        x = self.length * (0.5 - s)
        sides = np.stack([x, y + half], axis=1), np.stack([x, y - half], axis=1)[::-1]
        return np.concatenate(sides)

    def pictures(self, seconds: float, rate: float = 25.0) -> Iterator[NDArray[np.uint8]]:
        noise = np.random.default_rng(0)
        for time in np.arange(round(seconds * rate)) / rate:
            c, s = math.cos(self.heading(time)), math.sin(self.heading(time))
            turn = np.array([[c, s], [-s, c]])
            size, fine = (self.height, self.width), 3
            large = np.full((size[0] * fine, size[1] * fine), self.water, np.uint8)
            corners = ((self._outline(time) @ turn + self.place(time)) + 0.5) * fine - 0.5
            cv2.fillPoly(large, [np.rint(corners * 256).astype(np.int32)], self.body, shift=8)
            if self.tag is not None:
                self._paint_tag(large, turn, (self.place(time) + 0.5) * fine - 0.5)
            picture = cv2.resize(large, size[::-1], interpolation=cv2.INTER_AREA)
            yield np.clip(picture + 3.0 * noise.standard_normal(size, np.float32), 0, 255).astype(
                np.uint8
            )

    def _paint_tag(
        self, large: NDArray[np.uint8], turn: NDArray[np.float64], place: NDArray[np.float64]
    ) -> None:
        """Paint a tag of a third of the length, with a white margin, its upper edge ahead."""
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        tag = cv2.aruco.generateImageMarker(dictionary, self.tag, 80)
        tag = cv2.copyMakeBorder(tag, 10, 10, 10, 10, cv2.BORDER_CONSTANT, value=255)
        scale = self.length  # a third of it, of 100 pixels for a side of 80, three times as fine
        upright = np.array([[0.0, scale / 80], [-scale / 80, 0.0]])  # its top is ahead
        matrix = (turn.T @ upright.T).astype(np.float64)
        offset = place - matrix @ (49.5, 49.5)
        warp = np.concatenate([matrix, offset[:, None]], axis=1)
        shape = large.shape[::-1]
        inside = cv2.warpAffine(np.full_like(tag, 255), warp, shape, flags=cv2.INTER_NEAREST) > 0
        large[inside] = cv2.warpAffine(tag, warp, shape, flags=cv2.INTER_LINEAR)[inside]
