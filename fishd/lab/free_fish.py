"""Place, heading, speed and tail beat of a fish that swims by itself, from a video.

The fish is the largest thing that differs from the ground, which remains when it has swum on.
Its place is the centre of its area, and its axis that of the second moments. An AprilTag on its
back, if there is one, gives place and heading instead.
"""

import math
import random
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fishd.camera.tail.beats import Beat, average, find_maxima
from fishd.camera.tail.ground import shrink
from fishd.camera.video import Video, VideoPicture
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError

_WIDTH_PX = 640
"""Largest width of the pictures in which the fish is searched [px]."""
_GROUND_PICTURES = 60
_UNCOVERED = 0.9
"""Quantile of the grey levels of a place that shows the ground, beginning with the fish's."""
_MIN_CONTRAST = 12.0
"""Smallest difference of the fish from the ground [grey levels]."""
_LEVEL = 0.4
"""Difference that belongs to the fish, relative to its contrast."""
_MIN_AREA = 0.4
"""Smallest area of a whole fish, relative to the usual one."""
_END = 0.02
"""Part of the fish's length that is its end."""
_SMOOTH_S = 1.0
"""Time over which heading and speed are averaged before the beat is known [s]."""
_MIN_SEEN = 0.5
"""Smallest fraction of the pictures in which the fish is seen."""
_TAG_MARGIN = 1.4
"""Side of a tag with its white margin, relative to its side."""
_MAX_FREQUENCY_ERROR = 0.2
"""Largest half-width of the interval of the frequency, relative to it."""

Array = NDArray[np.float64]


class NoSwim(FishdError, ValueError):
    """A video does not show how a fish swims; the message says why."""


class Seen(NamedTuple):
    """Fish in one picture; lengths are in pixels of the picture."""

    time: float
    place: tuple[float, float] = (math.nan, math.nan)
    """Column and row of its centre, or of its tag."""
    axis: float = math.nan
    """Direction of its axis, or of its tag towards the head; clockwise is positive [rad]."""
    ends: tuple[float, float, float, float] = (math.nan,) * 4
    """Column and row of either end."""
    length: float = math.nan
    tag_side: float = math.nan
    reason: str = ""
    """Why it is unknown; else empty."""


class Swim(NamedTuple):
    """Motion of a fish; lengths are in `unit`, intervals are 95 % ones over the beats."""

    times: Array
    places: Array
    """Shape (pictures, 2); NaN where the fish was not seen."""
    heading: Array
    """Direction towards the head over whole beats; clockwise is positive, NaN at the ends of the
    video [rad]."""
    speed: Array
    """Speed of the centre over whole beats, a second; NaN at the ends of the video."""
    tail: Array
    """Place of the tail's end across the heading."""
    unit: str
    length: float
    """Length of the fish."""
    mean_speed: tuple[float, float]
    frequency: tuple[float, float]
    excursion: tuple[float, float]
    """From peak to peak of the tail's end, relative to the centre of the fish."""
    beats: int

    @property
    def strouhal(self) -> tuple[float, float]:
        """Strouhal number f A / U, with A the `excursion`, and half-width of its interval."""
        parts = (self.frequency, self.excursion, self.mean_speed)
        number = self.frequency[0] * self.excursion[0] / self.mean_speed[0]
        return number, number * math.hypot(*(error / value for value, error in parts))


class FreeFish:
    """Finder of the fish in the pictures of a video."""

    def __init__(self, video: Video, tag: int | None = None) -> None:
        """Learn the ground; tag: identifier of an AprilTag 36h11. Raises `NoSwim`."""
        self._tag = tag
        generator, kept = random.Random(0), list[Pixels]()
        for picture in video.pictures():
            place = len(kept)
            if place >= _GROUND_PICTURES:
                place = generator.randrange(picture.number + 1)
            if place < _GROUND_PICTURES:
                kept[place : place + 1] = [shrink(picture.pixels, _WIDTH_PX)]
        self._scale = video.size[0] / kept[0].shape[1]
        self._ground = _find_ground(np.stack(kept))
        changes = [self._change(small) for small in kept]
        # The fish may be away in most pictures.
        self._contrast = float(np.quantile([change.max() for change in changes], 0.8))
        noise = float(np.median([change.mean() for change in changes]))
        if self._contrast < max(_MIN_CONTRAST, 6.0 * noise):
            raise NoSwim(
                f"{video.shown}: nothing moves against a plain ground: let the fish swim through "
                "the picture"
            )
        areas = [np.count_nonzero(change > _LEVEL * self._contrast) for change in changes]
        self._area = float(np.quantile(areas, 0.8))
        if tag is not None:
            dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
            settings = cv2.aruco.DetectorParameters()
            settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
            self._detector = cv2.aruco.ArucoDetector(dictionary, settings)

    def _change(self, small: Pixels) -> NDArray[np.float32]:
        light = float(np.median(small)) / max(float(np.median(self._ground)), 1.0)
        change = np.abs(small / max(light, 1e-3) - self._ground).astype(np.float32)
        return np.asarray(cv2.blur(change, (3, 3)), np.float32)

    def find(self, picture: VideoPicture) -> Seen:
        """Return the fish in a picture."""
        change = self._change(shrink(picture.pixels, _WIDTH_PX))
        mask = (change > _LEVEL * self._contrast).astype(np.uint8)
        tag = None if self._tag is None else self._find_tag(picture.pixels)
        if tag is not None:  # it may look like the ground, and so divide the fish
            centre = tag.mean(axis=0)
            outline = ((tag - centre) * _TAG_MARGIN + centre + 0.5) / self._scale - 0.5
            cv2.fillConvexPoly(mask, np.rint(outline).astype(np.int32), 1)
        elif self._tag is not None:
            return Seen(picture.time, reason=f"the tag {self._tag} is not seen")
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
        sizes = stats[1:count, cv2.CC_STAT_AREA]
        if not len(sizes) or sizes.max() < _MIN_AREA * self._area:
            return Seen(picture.time, reason="no fish is seen")
        best = 1 + int(sizes.argmax())
        left, top, width, height = stats[best, :4]
        if min(left, top) == 0 or left + width == mask.shape[1] or top + height == mask.shape[0]:
            return Seen(picture.time, reason="the fish leaves the picture")
        rows, columns = np.nonzero(labels == best)
        points = np.stack([columns, rows], axis=1).astype(np.float64)
        weight = np.clip(change[rows, columns] / self._contrast, 0.0, 1.0)
        place = np.average(points, axis=0, weights=weight)
        covariance = np.cov(points.T, aweights=weight)
        axis = 0.5 * math.atan2(2.0 * covariance[0, 1], covariance[0, 0] - covariance[1, 1])
        along = (points - place) @ (math.cos(axis), math.sin(axis))
        reach = _END * float(np.ptp(along))
        ends = [points[along < along.min() + reach], points[along > along.max() - reach]]
        ends = [self._to_picture(end.mean(axis=0)) for end in ends]
        seen = Seen(
            time=picture.time,
            place=self._to_picture(place),
            axis=axis,
            ends=(*ends[0], *ends[1]),
            length=float(np.ptp(along)) * self._scale,
        )
        if tag is None:
            return seen
        x, y = tag[:2].mean(axis=0) - tag[2:].mean(axis=0)
        side = np.linalg.norm(np.roll(tag, 1, axis=0) - tag, axis=1).mean()
        return seen._replace(
            place=(float(tag[:, 0].mean()), float(tag[:, 1].mean())),
            axis=math.atan2(y, x),
            tag_side=float(side),
        )

    def _to_picture(self, place: Array) -> tuple[float, float]:
        x, y = (place + 0.5) * self._scale - 0.5
        return float(x), float(y)

    def _find_tag(self, picture: Pixels) -> Array | None:
        """Return the corners of the tag, clockwise from its upper left one."""
        corners, names, _ = self._detector.detectMarkers(picture)
        for corner, name in zip(corners, () if names is None else names.ravel(), strict=True):
            if name == self._tag:
                return np.asarray(corner, np.float64).reshape(4, 2)
        return None


def _find_ground(pictures: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the picture without the fish, which may cover a place most of the time."""
    low, middle, high = np.quantile(pictures, [1.0 - _UNCOVERED, 0.5, _UNCOVERED], axis=0)
    change = high - low
    still = change <= 0.5 * (change.min() + change.max())
    if still.all():
        return np.asarray(middle, np.float32)
    level = np.median(middle[still])
    is_dark = level - np.median(low[~still]) > np.median(high[~still]) - level
    ground = high if is_dark else low
    return np.asarray(ground + np.median((middle - ground)[still]), np.float32)


def describe_swim(seen: list[Seen], length_mm: float | None = None, *, tagged: bool) -> Swim:
    """Return the motion of a fish that was seen; raise `NoSwim`.

    length_mm: length of the fish, or of the side of its tag; None: lengths are in pixels
    """
    known = np.array([not each.reason for each in seen])
    if np.count_nonzero(known) < _MIN_SEEN * len(seen) or np.count_nonzero(known) < 20:
        reasons = sorted({each.reason for each in seen if each.reason})
        raise NoSwim(
            f"the fish is seen in {np.count_nonzero(known)} of {len(seen)} pictures"
            + (f": {reasons[0]}" if reasons else "; 20 are needed")
        )
    times = np.array([each.time for each in seen])
    measured = [each for each in seen if not each.reason]
    length = float(np.median([each.length for each in measured]))
    side = float(np.median([each.tag_side for each in measured]))
    scale = 1.0 if length_mm is None else length_mm / (side if tagged else length)
    grid = np.arange(times[known][0], times[known][-1], float(np.median(np.diff(times))))

    def resample(values: Array) -> Array:
        return np.stack([np.interp(grid, times[known], v) for v in values.T], axis=1)

    places = resample(np.array([each.place for each in measured]) * scale)
    ends = resample(np.array([each.ends for each in measured]) * scale)
    axes = np.array([each.axis for each in measured])
    turns = resample(np.stack([np.cos(2.0 * axes), np.sin(2.0 * axes)], axis=1))
    step, window = grid[1] - grid[0], _SMOOTH_S
    for _ in range(2):  # the second time over whole beats
        count = max(1, round(window / step)) | 1
        velocity = np.gradient(_smooth(places, count), step, axis=0)
        heading = 0.5 * np.unwrap(np.arctan2(*_smooth(turns, count).T[::-1]))
        ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        if float((ahead * velocity).sum()) < 0.0:
            heading, ahead = heading + math.pi, -ahead
        first = ((ends[:, :2] - ends[:, 2:]) * ahead).sum(axis=1) < 0.0
        offset = np.where(first[:, None], ends[:, :2], ends[:, 2:]) - places
        tail = offset[:, 1] * ahead[:, 0] - offset[:, 0] * ahead[:, 1]
        beats = find_maxima(grid.tolist(), (tail - _smooth(tail[:, None], count)[:, 0]).tolist())
        if len(beats) < 3:
            raise NoSwim("fewer than three whole beats of the tail are seen: a longer video helps")
        begins = np.array([beat.time for beat in beats])
        window = 2.0 * float(np.median(np.diff(begins)))
    edge = (times < grid[0] + window) | (times > grid[-1] - window)  # no whole mean there
    usual = np.diff(begins) < 0.75 * window  # no beat between was left out
    path = np.concatenate([[0.0], np.cumsum((velocity * ahead).sum(axis=1)[1:] * step)])
    periods = np.diff(begins)[usual]
    speeds = np.diff(np.interp(begins, grid, path))[usual] / periods
    speed, frequency = _average(speeds), _average(1.0 / periods)
    if not frequency[1] < _MAX_FREQUENCY_ERROR * frequency[0]:
        raise NoSwim("the tail does not beat evenly enough to be measured")
    if not speed[0] > speed[1]:
        raise NoSwim(
            "the fish does not swim on; leave out --free for a fish that is held, whose tail swings"
        )
    return Swim(
        times=times,
        places=np.array([each.place for each in seen]) * scale,
        heading=np.where(edge, np.nan, np.interp(times, grid, heading)),
        speed=np.where(edge, np.nan, np.interp(times, grid, np.linalg.norm(velocity, axis=1))),
        tail=np.where(known, np.interp(times, grid, tail), np.nan),
        unit="px" if length_mm is None else "mm",
        length=length * scale,
        mean_speed=speed,
        frequency=frequency,
        excursion=_average(np.array([2.0 * beat.alpha_max for beat in beats])),
        beats=len(beats),
    )


def _average(values: Array) -> tuple[float, float]:
    return average([Beat(0.0, float(value), 0.0) for value in values]) or (math.nan, math.nan)


def _smooth(values: Array, count: int) -> Array:
    """Return the mean over `count` values around each, twice; fewer at the ends."""
    for _ in range(2):
        half = [min(k, len(values) - 1 - k, count // 2) for k in range(len(values))]
        total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
        low, high = np.arange(len(values)) - half, np.arange(len(values)) + half + 1
        values = (total[high] - total[low]) / (high - low)[:, None]
    return values
