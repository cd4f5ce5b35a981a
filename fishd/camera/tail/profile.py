"""Midline of the tail in one picture, and the straight line through its fin.

A path that follows the tail is searched in a small picture by dynamic programming. Then, at full
size, the middle of the tail is the centroid of its profile on each of many normals of the path.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fishd.camera.tail.ground import Floats, Ground, shrink
from fishd.camera.tail.lens import Lens
from fishd.core.camera_frames import Pixels

STATIONS = 32
"""Number of places along the tail at which its middle is measured."""
_LINES = 5
"""Normals per station, whose profiles are averaged."""
_MAX_SLOPE = 3
"""Largest slope of the path against the axis."""
_PATH_LEVEL = 0.4
"""Cover above which a path is more likely on the tail than off it."""
_MARGIN = 0.035
"""Width of ground beside the tail that a profile includes, relative to the picture's width."""
_FLOOR, _CEILING = 0.2, 0.65
"""Covers that count as none of the tail and as all of it."""
_MIN_MASS = 0.5
"""Smallest area of a profile, relative to that of the tail at its station."""
SATURATED = 251
"""Grey level from which a pixel is too bright to show anything."""

Array = NDArray[np.float64]


class Pose(NamedTuple):
    """Place of the tail's root and direction of the fish's axis in a picture."""

    root: tuple[float, float]
    """Column and row [px]."""
    direction: float
    """Angle of the axis, towards the tip, against the rows [rad]."""

    def to_picture(self, points: Array) -> Array:
        """Return columns and rows of points along and across the axis, shape (…, 2) [px]."""
        c, s = math.cos(self.direction), math.sin(self.direction)
        turned = points @ np.array([[c, s], [-s, c]])
        return np.asarray(turned + self.root)

    def to_axis(self, points: Array) -> Array:
        """Return coordinates along and across the axis of points of a picture [px]."""
        c, s = math.cos(self.direction), math.sin(self.direction)
        return np.asarray((points - self.root) @ np.array([[c, -s], [s, c]]))

    def in_plane(self, lens: Lens, factor: float = 1.0) -> "Pose":
        """Return root and axis in the plane of the tail; factor: as for `Lens.to_plane`."""
        axis = np.array([[0.0, 0.0], [10.0, 0.0]])
        root, ahead = lens.to_plane(self.to_picture(axis), factor).tolist()
        return Pose((root[0], root[1]), math.atan2(ahead[1] - root[1], ahead[0] - root[0]))


class Trace(NamedTuple):
    """Midline of the tail in one picture."""

    places: Array
    """Columns and rows of the stations in the picture, shape (STATIONS, 2) [px]."""
    points: Array
    """Places along and across the axis from the root, in the plane of the tail [px]."""
    weight: Array
    """1 where the tail was seen at a station, 0 where not."""
    half: Array
    """Half of the tail's thickness at each station [px]."""
    glaring: NDArray[np.bool_]
    """Whether the profile at a station is overexposed."""
    length: float
    """Length of the path, on which `cover` is that of the tail [px]."""
    path: Array
    """Path on the small picture, in pixels of the picture, shape (n, 2)."""


class Tracer:
    """Finder of the midline."""

    def __init__(
        self,
        ground: Ground,
        pose: Pose,
        half_width: float,
        length: float | None = None,
        half: Array | None = None,
        lens: Lens | None = None,
        factor: float = 1.0,
    ) -> None:
        """
        half_width: largest half of the tail's thickness [px]
        length: length of the tail [px]; None: that seen in each picture
        half: half of the tail's thickness at each station [px]
        lens: maps the middles to the plane of the tail; None: it is that of the picture
        factor: as for `Lens.to_plane`
        """
        self._lens, self._factor = lens, factor
        self._plane = pose.in_plane(lens, factor) if lens else pose
        self._ground, self.pose, self.length = ground, pose, length
        width, height = ground.size
        scale = ground.scale
        self._half = np.full(STATIONS, half_width) if half is None else half
        reach = math.hypot(width, height) if length is None else 1.08 * length
        self._columns = max(8, round(min(reach, math.hypot(width, height)) / scale))
        self._middle = round(math.hypot(width, height) / 2 / scale)
        rows = 2 * self._middle + 1
        c, s = math.cos(pose.direction), math.sin(pose.direction)
        root = (np.array(pose.root) + 0.5) / scale - 0.5
        origin = root - self._middle * np.array([-s, c])
        self._warp = np.array([[c, -s, origin[0]], [s, c, origin[1]]], np.float64)
        thin = 0.0 if half is None else float(half[-3:].mean())
        self._blur = max(3, 2 * round(0.8 * thin / scale) + 1)
        self._start = max(2, round(half_width / scale))
        self._window = 1.5 * half_width / scale + 2.0
        self._v = np.arange(rows, dtype=np.float32)[:, None]
        self._kernel = np.ones((1, 2 * _MAX_SLOPE + 1), np.uint8)
        self._margin = _MARGIN * width

    def trace(self, picture: Pixels) -> Trace | None:
        """Return the midline in a picture; None where no tail is seen."""
        small = shrink(picture)
        light = self._ground.light(small)
        return self.trace_cover(picture, light, self._ground.cover(small, light))

    def trace_cover(self, picture: Pixels, light: Floats, cover: Floats) -> Trace | None:
        """Return the midline in a picture whose light and cover are known."""
        path = self._find_path(cover)
        return None if path is None else self._measure(picture, light, path)

    def _find_path(self, cover: Floats) -> Array | None:
        """Return the path on the small picture, along and across the axis [px of the picture]."""
        turned = cv2.warpAffine(
            cover,
            self._warp,
            (self._columns, len(self._v)),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        turned = np.clip((turned - _FLOOR) / (_CEILING - _FLOOR), 0.0, 1.0)
        reward = cv2.blur(turned, (1, self._blur)) - np.float32(_PATH_LEVEL)
        columns = np.ascontiguousarray(reward.T)
        score = np.full(len(self._v), -1e3, np.float32)
        start = slice(self._middle - self._start, self._middle + self._start + 1)
        score[start] = columns[0, start]
        scores = np.empty_like(columns)
        scores[0] = score
        for index in range(1, len(columns)):
            # The best predecessor is within the largest slope.
            score = cv2.dilate(score, self._kernel)[0] + columns[index]
            scores[index] = score
        last, row = divmod(int(scores.argmax()), scores.shape[1])
        if last < 5:
            return None
        rows = np.empty(last + 1)
        for index in range(last, -1, -1):
            rows[index] = row
            if index:
                low = max(0, row - _MAX_SLOPE)
                near = scores[index - 1, low : row + _MAX_SLOPE + 1]
                row = low + int(near.argmax())
        weight = turned[:, : last + 1] * (np.abs(self._v - rows[None, :]) <= self._window)
        mass = weight.sum(axis=0)
        centre = (weight * self._v).sum(axis=0) / np.maximum(mass, 1e-6)
        rows = np.where(mass > 0.5, centre, rows)
        padded = np.pad(rows, 2, mode="reflect", reflect_type="odd")
        rows = np.convolve(padded, [0.1, 0.2, 0.4, 0.2, 0.1], mode="valid")
        scale = self._ground.scale
        return np.asarray(np.stack([np.arange(last + 1.0), rows - self._middle], axis=1) * scale)

    def _measure(self, picture: Pixels, light: Floats, path: Array) -> Trace:
        """Return the midline from profiles on normals of a path."""
        steps = np.hypot(*np.diff(path, axis=0).T)
        arc = np.concatenate([[0.0], np.cumsum(steps)])
        length = self.length or float(arc[-1])
        end = np.polynomial.polynomial.polyfit(arc[-6:], path[-6:], 1)
        if arc[-1] < length:  # the path ends early: its straight end goes on
            arc = np.append(arc, length)
            path = np.concatenate([path, (end[0] + end[1] * length)[None]])
        places = (np.arange(STATIONS * _LINES) + 0.5) / (STATIONS * _LINES) * length
        middle = np.stack([np.interp(places, arc, path[:, k]) for k in (0, 1)], axis=1)
        tangent = np.gradient(middle, axis=0)
        window = _LINES * 2 + 1
        padded = np.pad(tangent, ((window // 2, window // 2), (0, 0)), mode="edge")
        tangent = np.stack(
            [np.convolve(padded[:, k], np.ones(window) / window, mode="valid") for k in (0, 1)],
            axis=1,
        )
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        reach = self._half + self._margin
        count = math.ceil(float(reach.max()) * 0.8)
        offsets = np.linspace(-1.0, 1.0, 2 * count + 1)
        across = np.repeat(reach, _LINES)[:, None] * offsets[None, :]
        points = middle[:, None] + across[..., None] * normal[:, None]
        seen = self.pose.to_picture(points).astype(np.float32)
        cover, grey = self._ground.sample(picture, light, seen)
        cover = cover.reshape(STATIONS, _LINES, -1).mean(axis=1)
        weight = np.clip((cover - _FLOOR) / (_CEILING - _FLOOR), 0.0, 1.0).astype(np.float64)
        mass = weight.sum(axis=1)
        shift = (weight @ offsets) / np.maximum(mass, 1e-9) * reach
        station = slice(_LINES // 2, None, _LINES)
        half = 0.5 * mass * reach / count
        near = np.abs(across[station]) <= self._half[:, None]
        bright = grey.reshape(STATIONS, _LINES, -1).max(axis=1) >= SATURATED
        glaring = (bright & near).sum(axis=1) > 0.15 * near.sum(axis=1)
        points = middle[station] + shift[:, None] * normal[station]
        places = self.pose.to_picture(points)
        if self._lens:
            points = self._plane.to_axis(self._lens.to_plane(places, self._factor))
        return Trace(
            places,
            points,
            ((half > _MIN_MASS * self._half) | (self.length is None)).astype(np.float64),
            half,
            glaring,
            float(arc[-1]) if self.length is None else float(steps.sum()),
            path,
        )


class Line(NamedTuple):
    """Straight line through the fin."""

    angle: float
    """Direction against the axis [rad]."""
    residual: float
    """Root mean square of the distances of the middles from the line [px]."""


def fit_line(points: Array, weight: Array) -> Line:
    """Return the line through points (n, 2), of which outliers count little.

    The distances are weighted by Tukey's biweight, with a scale from their median.
    """
    used = weight.copy()
    angle, distance = 0.0, np.zeros(len(points))
    for _ in range(5):
        total = used.sum()
        centre = used @ points / total
        offset = points - centre
        xx, yy = used @ offset[:, 0] ** 2, used @ offset[:, 1] ** 2
        xy = used @ (offset[:, 0] * offset[:, 1])
        angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
        distance = offset[:, 1] * math.cos(angle) - offset[:, 0] * math.sin(angle)
        spread = 1.4826 * float(np.median(np.abs(distance[weight > 0.0])))
        ratio = distance / (5.0 * max(spread, 0.05))
        used = weight * np.clip(1.0 - ratio**2, 0.0, None) ** 2
    return Line(angle, math.sqrt(float(used @ distance**2 / used.sum())))
