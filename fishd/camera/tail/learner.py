"""Learning of the ground, the tail and the zero from pictures of a fish that rests and swims.

The ground is the picture that remains when the tail has gone aside. Where the tail never leaves,
the ground is filled in from beside it. The fish's axis is that of the motion (`find_motion`), and
the zero is the direction of the fin while it rests, or the middle of its swing.
"""

import random
from datetime import UTC, datetime

import cv2
import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import NoMotion, find_motion
from fishd.camera.tail.ground import Floats, Ground, Mask, shrink, to_levels
from fishd.camera.tail.learned import ORDER, Learned, find_stations
from fishd.camera.tail.lens import Lens
from fishd.camera.tail.profile import STATIONS, Array, Pose, Trace, Tracer, fit_line
from fishd.camera.tail.scene import Scene
from fishd.camera.tail.shape import Shape
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError

MIN_SWING_RAD = 0.03
"""Smallest fin angle to either side that is sufficient [rad]."""
_MIN_PICTURES = 60
"""Fewest pictures that are sufficient."""
_MAX_BYTES = 24 * 2**20
"""Largest memory for pictures [bytes]."""
_LARGEST_WIDTH_PX = 400
"""Width to which wide pictures are reduced, which is half of most pictures' [px]."""
_MAX_PICTURES = 300
"""Largest number of pictures that are kept."""
_GROUND_PICTURES = 48
"""Number of pictures from which the ground is learned."""
_MOTION_WIDTH_PX = 110
"""Largest width of the pictures in which motion is searched [px]."""
_SWINGS, _MAX_RISE = 0.15, 0.04
"""Energy of a column that swings, relative to a large one, and the largest distance from where the
tail begins to such a column, relative to the picture's width."""
_UNCOVERED = 0.85
"""Quantile of the grey levels of a pixel that shows the ground, beginning with the tail's."""
_MIN_REST_S = 0.4
"""Shortest time that counts as rest [s]."""
_REST_RAD = 0.006
"""Largest deviation from the median while the fin rests, without noise [rad]."""
_NOTHING_SWINGS = "nothing swings: let the fish swim, and see that the camera looks at its tail"
_NO_SHAPE = (
    "what moves is not a tail that swings about its root at the left: turn the picture so that "
    "the head is at the left"
)
_MIN_WHOLE = 15
"""Fewest midlines without a gap that are sufficient."""
_MAX_SHAPE_ERROR = 0.02
"""Largest distance of the midlines from their common shape, relative to the picture's width."""
_WHITE, _MIN_DEVIATION = 0.5, 0.0005
"""Addition to the learned variance of distances from the shape: a fraction of it, and the square
of a distance relative to the picture's width."""
_EDGE_PX = 4.0
"""Distance from the picture's edge at which the tail counts as cut off [px]."""


class CannotLearn(FishdError, ValueError):
    """The pictures do not show what has to be learned."""


class Learner:
    """Collector of pictures, from which `finish` learns."""

    def __init__(self, lens: Lens | None = None) -> None:
        """lens: calibration of the camera; None without one"""
        self._lens = lens
        self._pictures: list[tuple[float, Pixels]] = []
        self._size = (0, 0)
        self._seen = 0
        self._random = random.Random(0)

    def add(self, time: float, picture: Pixels) -> None:
        """Take a whole turned picture of a time [s].

        Raise `CannotLearn` if its size changes, and `CannotUseLens` if it is not that of the lens.

        Of many pictures, a random choice is kept, at half their size or 400 px wide.
        """
        size = (picture.shape[1], picture.shape[0])
        if self._pictures and size != self._size:
            raise CannotLearn(
                f"the pictures change from {self._size[0]} × {self._size[1]} to {size[0]} × "
                f"{size[1]} pixels: learn from pictures of one size"
            )
        if self._lens:
            self._lens.check(size, self._lens.rotate)
        self._size = size
        self._seen += 1
        place = len(self._pictures)
        factor = max(2.0, size[0] / _LARGEST_WIDTH_PX)
        half = (max(1, round(size[0] / factor)), max(1, round(size[1] / factor)))
        if (place + 1) * half[0] * half[1] > _MAX_BYTES or place >= _MAX_PICTURES:
            place = self._random.randrange(self._seen)
            if place >= len(self._pictures):
                return
        kept = np.asarray(cv2.resize(picture, half, interpolation=cv2.INTER_AREA), np.uint8)
        self._pictures[place : place + 1] = [(time, kept)]

    def finish(self) -> Learned:
        """Return what the pictures show; raise `CannotLearn`."""
        if len(self._pictures) < _MIN_PICTURES:
            raise CannotLearn(
                f"{len(self._pictures)} pictures are too few to learn from; {_MIN_PICTURES} are "
                "needed: let the fish swim for ten seconds"
            )
        self._pictures.sort(key=lambda item: item[0])
        times = np.array([time for time, _ in self._pictures])
        pictures = [picture for _, picture in self._pictures]
        scene = _Scene(pictures, self._size[0] / pictures[0].shape[1])
        traces = _trace_all(scene, pictures, self._lens)
        seen = [trace for trace in traces if trace is not None]
        if len(seen) < 0.6 * len(traces):
            raise CannotLearn(
                f"the tail is seen in {len(seen)} of {len(traces)} pictures: see that the camera "
                "looks at the tail from above, and that nothing else moves"
            )
        times = times[[trace is not None for trace in traces]]
        points = np.stack([trace.points for trace in seen])
        weight = np.stack([trace.weight for trace in seen])
        swing = points[..., 1].std(axis=0)
        if np.count_nonzero(weight.min(axis=1)) < _MIN_WHOLE or swing[0] > swing[-1]:
            raise CannotLearn(_NO_SHAPE)
        scene.check_edges(np.stack([trace.places for trace in seen]))
        fin = _find_fin(points, weight)
        part = find_stations(fin)
        lines = [
            fit_line(trace.points[part], np.maximum(trace.weight[part], 0.01)) for trace in seen
        ]
        angle = np.array([line.angle for line in lines])
        zero, zero_ci95 = _find_zero(times, angle)
        alpha = angle - zero
        low, high = (float(value) for value in np.quantile(alpha, [0.01, 0.99]))
        if min(-low, high) < MIN_SWING_RAD:
            raise CannotLearn(
                f"too little swing to learn from: from {1e3 * low:.0f} to {1e3 * high:.0f} mrad; "
                f"{1e3 * MIN_SWING_RAD:.0f} mrad to both sides of the zero are needed"
            )
        shape, errors, differences = _learn_shape(
            alpha, points, weight, (low, high), _MIN_DEVIATION * scene.size[0]
        )
        if np.quantile(errors, 0.95) > _MAX_SHAPE_ERROR * scene.size[0]:
            raise CannotLearn(_NO_SHAPE)
        scale = scene.factor
        steps = np.diff(times)
        is_step = steps > 0.1 * np.median(steps)  # not the same picture again
        rates = np.abs(np.diff(alpha))[is_step] / steps[is_step]
        width, height = scene.size
        root = (np.array(scene.pose.root) + 0.5) * scale - 0.5
        half = np.median([trace.half for trace in seen], axis=0) * scale
        return Learned(
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            size=self._size,
            background_size=(width, height),
            background=scene.background.tobytes(),
            swept=np.packbits(scene.swept).tobytes(),
            tail_level=scene.tail_level,
            root=(float(root[0]), float(root[1])),
            direction=scene.pose.direction,
            zero=zero,
            zero_ci95=zero_ci95,
            span=(low, high),
            top_rate=float(np.quantile(rates, 0.98)),
            length=scene.length * scale,
            half_thickness=tuple(half.tolist()),
            fin=fin,
            shape=tuple(
                (tuple(along.tolist()), tuple(across.tolist()))
                for along, across in shape.coefficients * scale
            ),
            shape_error=float(np.quantile(errors, 0.95)) * scale,
            direction_error=float(np.quantile(differences[:, 0], 0.95)),
            turn_error=float(np.quantile(differences[:, 1], 0.95)),
            covariance=tuple(tuple(row.tolist()) for row in shape.covariance * scale**2),
            pose_error=_find_pose_error(scene, pictures),
            lens=self._lens,
            pixels_per_mm=self._lens.pixels_per_mm if self._lens else None,
        )


class _Scene:
    """Ground and tail in pictures of half the size."""

    def __init__(self, pictures: list[Pixels], factor: float) -> None:
        """factor: width of the whole pictures, in widths of these"""
        chosen = np.linspace(0, len(pictures) - 1, min(_GROUND_PICTURES, len(pictures)))
        some = np.stack([pictures[round(index)] for index in chosen])
        self.size = (some.shape[2], some.shape[1])
        self.factor = factor
        self.length, self.half = 0.0, np.zeros(STATIONS)
        even = _even_light(some)
        moving = self._find_motion(pictures)
        even.sort(axis=0)
        last = len(even) - 1
        places = 1, round((1.0 - _UNCOVERED) * last), last // 2, round(_UNCOVERED * last), last - 1
        dark, rather_dark, middle, rather_light, light = even[[*places]].astype(np.float32)
        is_light = self._is_light(dark, light, moving)
        empty, covered = (rather_dark, light) if is_light else (rather_light, dark)
        still = ~moving
        empty = empty + np.median((middle - empty)[still])
        covered = covered + np.median((middle - covered)[still])
        change = np.abs(covered - empty)
        strong = moving & (change > 0.6 * np.quantile(change[moving], 0.95))
        self.tail_level = float(np.median(covered[strong]))
        self._fill(np.clip(empty, 0.0, 255.0), moving)

    def _find_motion(self, pictures: list[Pixels]) -> Mask:
        """Return where the tail moves, and set the pose."""
        chosen = np.linspace(0, len(pictures) - 1, min(120, len(pictures)))
        small = np.stack([shrink(pictures[round(index)], _MOTION_WIDTH_PX) for index in chosen])
        try:
            motion = find_motion(_even_light(small))
        except NoMotion:
            raise CannotLearn(_NOTHING_SWINGS) from None
        height, width = motion.energy.shape
        energy = motion.energy / max(float(np.quantile(motion.energy, 0.99)), 1e-12)
        strong = energy > 0.02
        count, labels, sizes, _ = cv2.connectedComponentsWithStats(strong.astype(np.uint8))
        if count < 2:
            raise CannotLearn(_NOTHING_SWINGS)
        largest = 1 + int(sizes[1:, cv2.CC_STAT_AREA].argmax())
        mask = (labels == largest).astype(np.uint8)
        begin = int((mask.sum(axis=0) >= 2).argmax())
        swings = int(((mask * energy).max(axis=0) > _SWINGS).argmax())
        if swings - begin > _MAX_RISE * width:  # waves move the edges of the body, too
            begin = swings - 1
            mask[:, :begin] = 0
        scale = self.size[0] / width
        column = float(begin)
        row = float(motion.axis.rows(height, width)[int(column)])
        self.pose = Pose(
            ((column + 0.5) * scale - 0.5, (row + 0.5) * scale - 0.5), motion.axis.tilt
        )
        mask = cv2.resize(mask, self.size, interpolation=cv2.INTER_NEAREST)
        return np.asarray(mask) > 0

    def _is_light(self, dark: Floats, light: Floats, moving: Mask) -> bool:
        """Return whether the tail is lighter than the ground, which goes on beyond the sweep."""
        hull = _fill_columns(moving)  # a small swing leaves a middle that never moves
        inner = moving & (cv2.erode(hull, np.ones((7, 7), np.uint8)) == 0)
        ring = (cv2.dilate(hull, np.ones((9, 9), np.uint8)) - hull).astype(np.float32)
        total = cv2.blur(ring, (25, 25))
        near = inner & (total > 1e-3)

        def difference(level: Floats) -> float:
            beyond = cv2.blur(ring * level, (25, 25)) / np.maximum(total, 1e-6)
            return float(np.median(np.abs(level - beyond)[near]))

        return difference(dark) < difference(light)

    def _fill(self, empty: Array, moving: Mask) -> None:
        """Set the ground, also where the tail never leaves."""
        hull = np.asarray(cv2.dilate(_fill_columns(moving), np.ones((5, 5), np.uint8)), np.uint8)
        ground = np.median(empty[(cv2.dilate(hull, np.ones((15, 15), np.uint8)) > 0) & (hull == 0)])
        tail_like = np.abs(empty - self.tail_level) < np.abs(empty - ground)
        always = (tail_like & (hull > 0)).astype(np.uint8)
        always = np.asarray(cv2.dilate(always, np.ones((5, 5), np.uint8)), np.uint8) & hull
        smooth = cv2.blur(empty.astype(np.float32), (1, 5))
        rows = np.arange(len(empty))
        for column in np.flatnonzero(always.any(axis=0)):
            unknown = always[:, column] > 0
            # From beside the tail only: the body lies before it.
            empty[unknown, column] = np.interp(
                rows[unknown], rows[~unknown], smooth[~unknown, column]
            )
        self.background = (empty + 0.5).astype(np.uint8)
        self.swept: Mask = cv2.dilate(hull, np.ones((9, 9), np.uint8)) > 0
        root = np.array(self.pose.root)
        across = np.array([-np.sin(self.pose.direction), np.cos(self.pose.direction)])
        reach = np.arange(-self.size[1], self.size[1])
        places = root + 3.0 + reach[:, None] * across
        x, y = places.astype(int).T
        inside = (x >= 0) & (x < self.size[0]) & (y >= 0) & (y < self.size[1])
        thick = int((hull[y[inside], x[inside]] > 0).sum())
        self.half_width = max(0.5 * thick, 0.015 * self.size[0])
        # The ground begins at a column of the picture; the tail is measured across its axis.
        forward = 2.0 + self.half_width * abs(np.tan(self.pose.direction))
        x, y = self.pose.to_picture(np.array([forward, 0.0]))
        self.pose = self.pose._replace(root=(float(x), float(y)))
        self.ground = Ground(self.background, self.size, self.tail_level, self.swept)

    def check_edges(self, places: Array) -> None:
        """Raise `CannotLearn` if the tail leaves the picture."""
        if side := cut_off_side(places.reshape(-1, 2), self.size, 0.5 * _EDGE_PX):
            raise CannotLearn(
                f"the tail leaves the picture at the {side}: raise the camera or let the fish "
                "swim with a smaller amplitude"
            )


def cut_off_side(places: Array, size: tuple[int, int], margin: float = _EDGE_PX) -> str:
    """Return at which side points of a picture lie beyond its edge; empty if at none."""
    if places[:, 0].max() > size[0] - 1 - margin:
        return "right"
    if places[:, 1].min() < margin:
        return "top"
    return "bottom" if places[:, 1].max() > size[1] - 1 - margin else ""


def _fill_columns(mask: Mask) -> Pixels:
    """Return 1 in each column from the first to the last row of a mask, else 0."""
    filled = np.maximum.accumulate(mask, axis=0) & np.maximum.accumulate(mask[::-1], axis=0)[::-1]
    return filled.astype(np.uint8)


def _even_light(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return pictures without changes of the light, of the whole picture or of its rows.

    They are converted one at a time, because floats of all take four times their memory.
    """
    mean = pictures.mean(axis=(1, 2))
    factors = (mean.mean() / mean).astype(np.float32)
    bright = np.empty_like(pictures)
    for picture, factor, whole in zip(pictures, factors, bright, strict=True):
        whole[:] = to_levels(picture * factor)
    spread = bright.max(axis=0).astype(np.float32) - bright.min(axis=0)
    still = spread < np.median(spread) + 0.3 * (spread.max() - np.median(spread))
    typical = np.median(bright[::2], axis=0)
    known = still.sum(axis=1) >= 8
    total = np.maximum((typical * still).sum(axis=1), 1.0)
    rows = np.arange(len(typical))
    for picture, factor, even in zip(pictures, factors, bright, strict=True):
        light = (picture * still).sum(axis=1) * factor / total
        light = np.interp(rows, rows[known], light[known]).astype(np.float32)
        even[:] = to_levels(picture * (factor / light)[:, None])
    return bright


def _trace_all(scene: _Scene, pictures: list[Pixels], lens: Lens | None) -> list[Trace | None]:
    """Return the midlines, after the length of the tail has been found in some pictures."""
    tracer = Tracer(scene.ground, scene.pose, scene.half_width)
    some = [
        trace for picture in pictures[:: len(pictures) // 40] if (trace := tracer.trace(picture))
    ]
    if len(some) < 15:
        raise CannotLearn(_NOTHING_SWINGS)
    scene.length = float(np.quantile([trace.length for trace in some], 0.6))
    scene.half = np.median([trace.half for trace in some], axis=0)
    tracer = Tracer(
        scene.ground, scene.pose, scene.half_width, scene.length, scene.half, lens, scene.factor
    )
    return [tracer.trace(picture) for picture in pictures]


def _find_pose_error(scene: _Scene, pictures: list[Pixels]) -> tuple[float, float, float]:
    """Return the 95 % quantiles of shifts [px of the whole picture] and turn [rad]."""
    ground, still = scene.ground, Scene(scene.ground)
    small = [shrink(picture) for picture in pictures]
    poses = [still.find_pose(picture, ground.light(picture))[0] for picture in small]
    along, down, turn = np.quantile(np.abs(poses), 0.95, axis=0).tolist()
    return ground.scale * scene.factor * along, ground.scale * scene.factor * down, turn


def _find_fin(points: Array, weight: Array) -> tuple[float, float]:
    """Return which part of the tail is straight, in fractions of its length from the tip."""
    tip = 2
    last, first = STATIONS - tip, STATIONS - STATIONS // 4
    # Against the place of the tip, because its errors are small and those of directions are not.
    across = points[:, first:last, 1].mean(axis=1)
    centred = across - across.mean()
    steps = np.diff(points, axis=1)
    direction = np.arctan2(steps[..., 1], steps[..., 0])
    gain = centred @ (direction - direction.mean(axis=0))
    gain = gain[: last - 1]
    place = np.arange(1.0, len(gain) + 1.0)
    best, begin = np.inf, 0
    for joint in range(round(0.3 * STATIONS), round(0.75 * STATIONS) + 1):
        # Before the joint, the bend decreases towards it.
        table = np.stack([np.ones(len(gain)), np.clip(joint - place, 0.0, None) ** 2], axis=1)
        error = float(np.sum((table @ np.linalg.lstsq(table, gain, rcond=None)[0] - gain) ** 2))
        if error < best:
            best, begin = error, joint
    return tip / STATIONS, 1.0 - begin / STATIONS


def _find_zero(times: Array, angle: Array) -> tuple[float, float]:
    """Return the direction of the fin at rest and the half-width of its 95 % interval [rad]."""
    # The smallest of the second differences are those of rest; 0.126 σ is their 10 % quantile.
    noise = float(np.quantile(np.abs(np.diff(angle, 2)), 0.1)) / (0.126 * 6**0.5)
    begin, best, swing = 0, (0, 1), float(np.ptp(np.quantile(angle, [0.02, 0.98])))
    limit = min(_REST_RAD + 3.0 * noise, 0.05 * swing)
    for end in range(1, len(times) + 1):
        while np.ptp(np.quantile(angle[begin:end], [0.1, 0.9])) > limit:
            begin += 1
        if times[end - 1] - times[begin] > times[best[1] - 1] - times[best[0]]:
            best = begin, end
    if best[1] - best[0] >= 8 and times[best[1] - 1] - times[best[0]] >= _MIN_REST_S:
        rest = angle[best[0] : best[1]]
        inner = rest[len(rest) // 8 : len(rest) - len(rest) // 8]
        return float(np.median(inner)), float(2.0 * np.std(inner) / (len(inner) / 4) ** 0.5 + 5e-4)
    low, high = np.quantile(angle, [0.02, 0.98])
    return float(0.5 * (low + high)), 0.02


def _learn_shape(
    alpha: Array, points: Array, weight: Array, span: tuple[float, float], min_deviation: float
) -> tuple[Shape, Array, Array]:
    """Return the shape, and the distances and differences of direction of pictures from it."""
    shape = Shape.learn(alpha, points, weight, ORDER)
    for _ in range(2):  # the second time without the pictures that fit worst
        fits = [shape.fit(*each, span) for each in zip(points, weight, alpha, strict=True)]
        errors = np.array([fit.error for fit in fits])
        usual = errors <= np.quantile(errors, 0.9)
        shape = Shape.learn(alpha[usual], points[usual], weight[usual], ORDER)
    known = (errors <= np.quantile(errors, 0.95)) & (weight.min(axis=1) > 0.0)
    distances = np.array(
        [
            shape.find_distances(each, shape.fit(each, np.ones(STATIONS), a, span).alpha)
            for each, a in zip(points[known], alpha[known], strict=True)
        ]
    )
    covariance = distances.T @ distances / max(len(distances), 1)
    white = _WHITE * float(np.trace(covariance)) / STATIONS + min_deviation**2
    shape = Shape(shape.coefficients, covariance + white * np.eye(STATIONS))
    fits = [shape.fit(*each, span) for each in zip(points, weight, alpha, strict=True)]
    differences = np.abs([(a - fit.alpha, fit.turn) for a, fit in zip(alpha, fits, strict=True)])
    return shape, np.array([fit.error for fit in fits]), differences
