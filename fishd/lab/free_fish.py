"""Place, heading, speed and tail beat of a fish that swims by itself, from a video.

The fish is the largest thing that differs from the ground, which remains when it has swum on, or
which goes on beside a fish that keeps its place. Its place is the centre of its area, and its axis
that of the second moments; its head is at the end that swings less. An AprilTag on its back, if
there is one, gives place and heading instead.
"""

import math
import random
from collections import Counter
from typing import Any, NamedTuple

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fishd.camera.tail.beats import Beat, average, find_maxima
from fishd.camera.tail.ground import shrink, to_levels
from fishd.camera.video import Video, VideoPicture
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError
from fishd.core.tail_reading import MIDLINE_POINTS

_WIDTH_PX = 640
"""Largest width of the pictures in which the fish is searched; a small one is then looked at in
the whole picture [px]."""
_GROUND_PICTURES = 60
_UNCOVERED = 0.9
"""Quantile of the grey levels of a place that shows the ground, beginning with the fish's."""
_MIN_CONTRAST = 12.0
"""Smallest difference of the fish from the ground [grey levels]."""
_LEVEL, _NOISE = 0.2, 6.0
"""Difference that belongs to the fish, with its thin tail: at least this part of its contrast, and
this multiple of the usual difference."""
_MIN_AREA = 0.4
"""Smallest area of a whole fish, relative to the usual one."""
_MIN_PIXELS = 16
"""Smallest area of a fish [px]."""
_END = 0.02
"""Part of the fish's length that is its end."""
_SMOOTH_S = 1.0
"""Time over which heading and speed are averaged before the beat is known [s]."""
_MIN_SEEN = 0.5
"""Smallest fraction of the pictures in which the fish is seen."""
_TAG_MARGIN = 1.4
"""Side of a tag with its white margin, relative to its side."""
_MIN_STRIDE = 0.05
"""Smallest way of a beat of a fish that swims on, relative to its length."""
_MAX_ROUGHNESS = 0.5
"""Largest second difference of the tail's place from picture to picture, relative to that of noise
of the same size; five pictures a beat have less."""
_MAX_FREQUENCY_ERROR = 0.2
"""Largest half-width of the interval of the frequency, relative to it."""

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Complex = NDArray[Any]


class NoSwim(FishdError, ValueError):
    """A video does not show how a fish swims; the message says why."""


class Seen(NamedTuple):
    """Fish in one picture; lengths are in pixels of the picture."""

    time: float
    place: Array = np.full(2, math.nan)
    """Column and row of its centre, or of its tag."""
    axis: float = math.nan
    """Direction of its axis, or of its tag towards the head; clockwise is positive [rad]."""
    length: float = math.nan
    tag_side: float = math.nan
    midline: Array = np.full((MIDLINE_POINTS, 2), math.nan)
    """Columns and rows of points at equal distances along the axis, from one end to the other."""
    reason: str = ""
    """Why it is unknown; else empty."""


class Swim(NamedTuple):
    """Motion of a fish; lengths are in `unit`, intervals are 95 % ones over the beats.

    An interval is NaN for a single beat, and all values about beats where `problem` says why.
    """

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
    is_tail_first: NDArray[np.bool_]
    """Whether a picture's midline begins at the tail."""
    maxima: Array
    """Times of the tail's reversals to the right, and its place there."""
    scale: float
    """Length of a pixel."""
    unit: str
    length: float
    """Length of the fish."""
    mean_speed: tuple[float, float]
    """Towards the head."""
    frequency: tuple[float, float]
    excursion: tuple[float, float]
    """From peak to peak of the tail's end, relative to the centre of the fish."""
    beats: int
    problem: str
    """Why the beat cannot be measured; else empty."""

    @property
    def strouhal(self) -> tuple[float, float] | None:
        """Strouhal number f A / U, with A the `excursion`, and half-width of its interval.

        None for a fish that does not swim on.
        """
        speed, ci95 = self.mean_speed
        if self.problem or speed < _MIN_STRIDE * self.length * self.frequency[0] or speed < ci95:
            return None
        parts = (self.frequency, self.excursion, self.mean_speed)
        number = self.frequency[0] * self.excursion[0] / self.mean_speed[0]
        return number, number * math.hypot(*(error / value for value, error in parts))


class FreeGround(Struct, frozen=True):
    """Picture of a video without the fish, and how the fish differs from it."""

    picture: bytes
    """Grey levels, row by row, of a picture of `size`."""
    size: tuple[int, int]
    contrast: float = 0.0
    """Difference of the fish [grey levels]."""
    level: float = 0.0
    """Smallest difference that belongs to the fish [grey levels]."""
    area: float = 0.0
    """Usual area of the fish [px]."""

    def levels(self) -> NDArray[np.uint8]:
        """Return the picture."""
        return np.frombuffer(self.picture, np.uint8).reshape(self.size[::-1])


def learn_ground(video: Video) -> FreeGround:
    """Return the ground of a video; raise `NoSwim` if nothing moves."""
    generator, kept = random.Random(0), list[Pixels]()
    for picture in video.pictures():
        place = len(kept)
        if place >= _GROUND_PICTURES:
            place = generator.randrange(picture.number + 1)
        if place < _GROUND_PICTURES:
            kept[place : place + 1] = [shrink(picture.pixels, _WIDTH_PX)]
    height, width = kept[0].shape
    levels = to_levels(_find_ground(np.stack(kept)))
    finder = FreeFish(FreeGround(levels.tobytes(), (width, height)), video)
    changes = [finder.compare(small)[0] for small in kept]
    # The fish may be away in most pictures.
    contrast = float(np.quantile([change.max() for change in changes], 0.8))
    noise = float(np.median([np.median(change) for change in changes]))
    if contrast < max(_MIN_CONTRAST, _NOISE * noise):
        raise NoSwim(
            f"{video.shown}: nothing moves against a plain ground: let the fish swim through "
            "the picture"
        )
    level = max(_LEVEL * contrast, _NOISE * noise)
    area = float(np.quantile([np.count_nonzero(change > level) for change in changes], 0.8))
    return FreeGround(levels.tobytes(), (width, height), contrast, level, area)


class FreeFish:
    """Finder of the fish in the pictures of a video."""

    def __init__(self, ground: FreeGround, video: Video, tag: int | None = None) -> None:
        """tag: identifier of an AprilTag 36h11"""
        self._tag = tag
        self._scale = video.size[0] / ground.size[0]
        self._size, self._read_out = video.size, video.read_out
        self._ground = ground.levels().astype(np.float32)
        self._whole = np.asarray(cv2.resize(self._ground, video.size), np.float32)
        self._contrast, self._level, self._area = ground.contrast, ground.level, ground.area
        if tag is not None:
            dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
            settings = cv2.aruco.DetectorParameters()
            settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
            self._detector = cv2.aruco.ArucoDetector(dictionary, settings)

    def compare(self, small: Pixels) -> tuple[Floats, float]:
        """Return the difference of a small picture from the ground, and its relative light."""
        some = slice(None, None, 4)
        ratio = small[some, some] / np.maximum(self._ground[some, some], 1.0)
        light = max(float(np.median(ratio)), 1e-3)
        return _difference(small, light, self._ground), light

    def find(self, picture: VideoPicture) -> Seen:
        """Return the fish in a picture."""
        change, light = self.compare(shrink(picture.pixels, _WIDTH_PX))
        tag = None if self._tag is None else self._find_tag(picture.pixels)
        if self._tag is not None and tag is None:
            return Seen(picture.time, reason="its tag is not seen")
        scale, corner = self._scale, np.zeros(2)
        shape, box = self._find_largest(change, tag, scale, corner)
        if box[4] < max(_MIN_AREA * self._area, _MIN_PIXELS):
            return Seen(picture.time, reason="no fish is seen")
        first, last = box[:2], box[:2] + box[2:4]
        if first.min() == 0 or (last == shape.shape[::-1]).any():
            return Seen(picture.time, reason="the fish leaves the picture")
        if scale > 1.0 and scale * (last - first).max() < _WIDTH_PX:
            first = np.maximum(0, (scale * (first - 2)).astype(int))
            last = np.ceil(scale * (last + 2)).astype(int)
            part = slice(first[1], last[1]), slice(first[0], last[0])
            change = _difference(picture.pixels[part], light, self._whole[part])
            scale, corner = 1.0, first.astype(np.float64)
            shape, _ = self._find_largest(change, tag, scale, corner)
            if not shape.any():
                return Seen(picture.time, reason="no fish is seen")
        rows, columns = np.nonzero(shape)
        points = np.stack([columns, rows], axis=1).astype(np.float64)
        weight = np.clip(change[rows, columns] / self._contrast, 0.0, 1.0)
        place = np.average(points, axis=0, weights=weight)
        covariance = np.cov(points.T, aweights=weight)
        axis = 0.5 * math.atan2(2.0 * covariance[0, 1], covariance[0, 0] - covariance[1, 1])
        along = (points - place) @ (math.cos(axis), math.sin(axis))
        seen = Seen(
            time=picture.time,
            place=(place + 0.5) * scale - 0.5 + corner,
            axis=axis,
            length=float(np.ptp(along) - 1.0) * scale,  # the blur lets it end a pixel later
            midline=(_find_midline(points, along) + 0.5) * scale - 0.5 + corner,
        )
        if tag is None:
            return self._at_row_time(seen)
        x, y = tag[:2].mean(axis=0) - tag[2:].mean(axis=0)
        side = np.linalg.norm(np.roll(tag, 1, axis=0) - tag, axis=1).mean()
        place = tag.mean(axis=0)
        return self._at_row_time(
            seen._replace(place=place, axis=math.atan2(y, x), tag_side=float(side))
        )

    def _at_row_time(self, seen: Seen) -> Seen:
        """Return the same at the time of exposure of the row, or column, of the fish's centre."""
        (width, height), (row_time, column_time) = self._size, self._read_out
        late = column_time * (seen.place[0] / max(width - 1, 1) - 0.5)
        late += row_time * (seen.place[1] / max(height - 1, 1) - 0.5)
        return seen._replace(time=float(seen.time + late))

    def _find_largest(
        self, change: Floats, tag: Array | None, scale: float, corner: Array
    ) -> tuple[NDArray[np.bool_], NDArray[np.int32]]:
        """Return where the largest thing that differs is, and its box and area.

        scale, corner: pixels of the picture for one of `change`, and its place in the picture
        """
        mask = (change > self._level).astype(np.uint8)
        if tag is not None:  # it may look like the ground, and so divide the fish
            centre = tag.mean(axis=0)
            outline = (tag - centre) * _TAG_MARGIN + centre - corner
            outline = (outline + 0.5) / scale - 0.5
            cv2.fillConvexPoly(mask, np.rint(outline).astype(np.int32), 1)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
        if len(stats) == 1:
            return mask > 0, np.zeros(5, np.int32)
        best = int(stats[1:, cv2.CC_STAT_AREA].argmax()) + 1
        return np.asarray(labels == best), np.asarray(stats[best], np.int32)

    def _find_tag(self, picture: Pixels) -> Array | None:
        """Return the corners of the tag, clockwise from its upper left one."""
        corners, names, _ = self._detector.detectMarkers(picture)
        for corner, name in zip(corners, () if names is None else names.ravel(), strict=True):
            if name == self._tag:
                return np.asarray(corner, np.float64).reshape(4, 2)
        return None


def _difference(pixels: Pixels, light: float, ground: Floats) -> Floats:
    change = np.abs(pixels / light - ground).astype(np.float32)
    return np.asarray(cv2.blur(change, (3, 3)), np.float32)


def _find_midline(points: Array, along: Array) -> Array:
    """Return the middles of a fish, shape (MIDLINE_POINTS, 2).

    points, along: columns and rows of all its pixels, shape (n, 2), and their places on its axis
    """
    low, high = along.min(), along.max()
    reach = _END * (high - low)
    station = np.rint((along - low) / (high - low) * (MIDLINE_POINTS - 1)).astype(int)
    count = np.bincount(station, minlength=MIDLINE_POINTS)
    sums = [np.bincount(station, values, minlength=MIDLINE_POINTS) for values in points.T]
    midline = np.stack(sums, axis=1) / np.where(count, count, np.nan)[:, None]
    midline[0] = points[along < low + reach].mean(axis=0)
    midline[-1] = points[along > high - reach].mean(axis=0)
    return midline


def _find_ground(pictures: NDArray[np.uint8]) -> Floats:
    """Return the picture without the fish, which may cover a place most of the time, or always."""
    levels = np.quantile(pictures, np.linspace(1.0 - _UNCOVERED, _UNCOVERED, 5), axis=0)
    low, middle, high = levels[::2]
    change = np.asarray(cv2.blur(high - low, (3, 3)))
    moving = change > 0.5 * (change.min() + change.max())
    if change.max() < max(_MIN_CONTRAST, 3.0 * float(np.median(change))):  # it is noise
        return np.asarray(middle, np.float32)
    level = np.median(middle[~moving])
    is_dark = level - np.median(low[moving]) > np.median(high[moving]) - level
    fish = low if is_dark else high
    some = levels[2:] if is_dark else levels[:3]  # a tag may be on the other side of the ground
    some = some + np.median((middle - some)[:, ~moving], axis=1)[:, None, None]
    nearest = np.abs(some - level).argmin(axis=0)
    ground = np.take_along_axis(some, nearest[None], axis=0)[0].astype(np.float32)
    is_like_fish = np.abs(ground - np.median(fish[moving])) < np.abs(ground - level)
    _, labels = cv2.connectedComponents(is_like_fish.astype(np.uint8))
    near = np.unique(labels[cv2.dilate(moving.astype(np.uint8), np.ones((5, 5))) > 0])
    beyond = [0, *labels[[0, -1]].ravel(), *labels[:, [0, -1]].ravel()]  # the wall of a tank
    body = np.isin(labels, np.setdiff1d(near, beyond)).astype(np.uint8)
    body = np.asarray(cv2.dilate(body, np.ones((9, 9))), np.uint8)
    filled = cv2.inpaint(to_levels(ground), body, 3.0, cv2.INPAINT_TELEA)
    return np.where(body > 0, filled, ground)


def describe_swim(
    seen: Array, reasons: Counter[str], length_mm: float | None = None, *, tagged: bool
) -> Swim:
    """Return the motion of a fish that was seen; raise `NoSwim`.

    seen: time, place, axis, length, side of the tag, and either end of the midline, as in `Seen`,
        of each picture; shape (10, pictures)
    reasons: why it was not seen, with the number of pictures
    length_mm: length of the fish, or of the side of its tag; None: lengths are in pixels
    """
    known = np.isfinite(seen[1])
    if np.count_nonzero(known) < _MIN_SEEN * len(known) or np.count_nonzero(known) < 20:
        reason = reasons.most_common(1)
        raise NoSwim(
            f"the fish is seen in {np.count_nonzero(known)} of {len(known)} pictures"
            + (f": {reason[0][0]}" if reason else "; 20 are needed")
        )
    times, (length, side) = seen[0], np.median(seen[4:6, known], axis=1)
    scale = 1.0 if length_mm is None else length_mm / (side if tagged else length)
    grid = np.arange(times[known][0], times[known][-1], float(np.median(np.diff(times))))

    def resample(values: Complex) -> Complex:
        return np.asarray(np.interp(grid, times[known], values[known]))

    # Vectors are complex numbers, of which the real part is along the rows.
    pairs = [scale * (seen[k] + 1j * seen[k + 1]) for k in (1, 6, 8)]
    place, first, second = (resample(pair) for pair in pairs)
    axis, step, window = resample(np.exp(2j * seen[3])), grid[1] - grid[0], _SMOOTH_S
    problem = ""
    for _ in range(2):  # the second time over whole beats
        count = max(1, round(window / step)) | 1
        heading = 0.5 * np.unwrap(np.angle(_smooth(axis, count)))
        ahead = np.exp(1j * heading)
        is_first = ((first - second) * ahead.conj()).real < 0.0
        rear = ((np.where(is_first, first, second) - place) * ahead.conj()).imag
        front = ((np.where(is_first, second, first) - place) * ahead.conj()).imag
        if (front - _smooth(front, count)).std() > (rear - _smooth(rear, count)).std():
            heading, ahead, rear = heading + math.pi, -ahead, -front
        swing = (rear - _smooth(rear, count)).real
        tops, backs = (find_maxima(grid.tolist(), (k * swing).tolist()) for k in (1.0, -1.0))
        turns = [
            np.sort([beat.time for beat in one] + [beat.back for beat in other])
            for one, other in ((tops, backs), (backs, tops))
        ]
        half = float(np.median([beat.back - beat.time for beat in tops + backs] or [0.0]))
        turns = [turn[np.diff(turn, prepend=-np.inf) > 0.5 * half] for turn in turns]  # seen twice
        begins = np.concatenate([turn[:-1] for turn in turns])
        ends = np.concatenate([turn[1:] for turn in turns])
        if not len(begins):
            problem = "fewer than two whole beats are seen: a longer video helps"
            break
        window = float(np.median(ends - begins))
    usual = ends - begins < 1.5 * window  # no beat between was left out
    begins, ends = begins[usual], ends[usual]
    moved = np.interp(ends, grid, place) - np.interp(begins, grid, place)
    moved *= np.interp(0.5 * (begins + ends), grid, ahead).conj()
    frequency = _average(1.0 / (ends - begins))
    if frequency[1] > _MAX_FREQUENCY_ERROR * frequency[0]:
        problem = "it is not even enough to be measured"
    if np.diff(swing, 2).std() > _MAX_ROUGHNESS * math.sqrt(6.0) * swing.std():
        problem = "it is lost in the noise, or between the pictures"
    excursion = _average(np.array([2.0 * beat.alpha_max for beat in tops + backs]))
    unknown = (math.nan, math.nan)
    margin = (count + 1) * step  # no whole mean there
    edge = (times < grid[0] + margin) | (times > grid[-1] - margin)
    velocity = np.gradient(_smooth(place, count), step)
    way = np.interp(times, grid, ahead).conj()
    return Swim(
        times=times,
        places=scale * seen[1:3].T,
        heading=np.where(edge, np.nan, np.interp(times, grid, heading)),
        speed=np.where(edge, np.nan, np.interp(times, grid, np.abs(velocity))),
        tail=np.where(known, np.interp(times, grid, rear), np.nan),
        is_tail_first=((pairs[1] - pairs[2]) * way).real < 0.0,
        maxima=np.array([(time, np.interp(time, grid, rear)) for time in turns[0]]).reshape(-1, 2),
        scale=float(scale),
        unit="px" if length_mm is None else "mm",
        length=float(length * scale),
        mean_speed=unknown if problem else _average(moved.real / (ends - begins)),
        frequency=unknown if problem else frequency,
        excursion=unknown if problem else excursion,
        beats=max(len(tops), len(backs)),
        problem=problem,
    )


def _average(values: Array) -> tuple[float, float]:
    """Return the mean over beats that begin on either side, and the half-width of its interval.

    Such beats overlap by half, so they count half.
    """
    mean = average([Beat(0.0, float(value), 0.0) for value in values])
    value, ci95 = mean or (values[0] if len(values) else math.nan, math.nan)
    return float(value), math.sqrt(2.0) * ci95


def _smooth(values: Complex, count: int) -> Complex:
    """Return the mean over `count` values around each, twice; at either end, its trend goes on."""
    count = min(count, (len(values) + 1) // 2)
    kernel = np.convolve(np.ones(count), np.ones(count)) / count**2
    inner = np.convolve(values, kernel, mode="valid")
    low, high = inner[0], inner[-1]
    rise, fall = (
        (0.0, 0.0) if len(inner) <= count else (inner[count] - low, high - inner[-1 - count])
    )
    steps = np.arange(1, count) / count
    return np.concatenate([low - rise * steps[::-1], inner, high + fall * steps])
