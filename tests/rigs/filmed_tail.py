"""Film of a swinging tail whose fin angle is known, with the faults of real pictures.

The outline of the tail is a polygon. Each of its corners passes through the tilt, the lens, the
waves and the rolling shutter; then the polygon is filled at four times the size and scaled down.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Motion = Callable[[Floats], Floats]
"""Fin angle [rad] at times [s]."""

FIN_FROM = 0.55
"""Fraction of the tail's length at which the straight fin begins."""
SAMPLES = 4
"""Samples per pixel along both directions."""
_STATIONS = 48


def sine(amplitude: float = 0.42, frequency: float = 2.0, offset: float = 0.0) -> Motion:
    return lambda time: offset + amplitude * np.sin(math.tau * frequency * time)


def rest_before(seconds: float, motion: Motion) -> Motion:
    return lambda time: np.where(time < seconds, 0.0, motion(np.maximum(time - seconds, 0.0)))


def random_motion(seed: int, seconds: float, amplitude: float = 0.3, speed: float = 6.0) -> Motion:
    """Return a fin that follows random instructions, held for 0.05 s, as a servo and water do."""
    generator = np.random.default_rng(seed)
    step = 1e-3
    instructions = np.repeat(generator.uniform(-1.0, 1.0, int(seconds / 0.05) + 2), 50)
    times = step * np.arange(len(instructions))
    angles, wheel, angle, rate = [], 0.0, 0.0, 0.0
    for instruction in 2.0 * amplitude * instructions:
        wheel += np.clip(instruction - wheel, -speed * step, speed * step)
        rate += step * (12.5**2 * (wheel - angle) - 2 * 1.2 * 12.5 * rate)
        angle += step * rate
        angles.append(angle)
    return lambda time: np.interp(time, times, angles)


def backlash(half_width: float, amplitude: float = 0.3, frequency: float = 0.5) -> Motion:
    """Return a fin behind a drive with play, whose instruction is `sine(amplitude, frequency)`."""
    step = 1e-3
    times = np.arange(0.0, 30.0, step)
    fin, angles = 0.0, []
    for instruction in sine(amplitude, frequency)(times):
        fin = min(max(fin, instruction - half_width), instruction + half_width)
        angles.append(fin)
    return lambda time: np.interp(time, times, angles)


class Thing(NamedTuple):
    """Ellipse on the surface, such as a hand, another fish or a leaf; lengths are fractions."""

    start: tuple[float, float]
    """Place at time 0: from the left edge, and below the middle row."""
    velocity: tuple[float, float]
    """Widths of the picture per second."""
    half_axes: tuple[float, float]
    direction: float = 0.5
    """Direction of the first axis against the rows [rad]."""
    level: float | None = None
    """Grey level; None: that of the tail."""


class Knock(NamedTuple):
    """Change of the camera's pose."""

    time: float
    """Time from which the picture is changed [s]."""
    turn: float = 0.0
    """Turn about the centre of the picture [rad]."""
    zoom: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    """Fractions of the picture's width."""


@dataclass(frozen=True)
class Film:
    """Settings of a film; lengths are fractions of the picture's width unless said otherwise."""

    motion: Motion = field(default_factory=lambda: rest_before(1.0, sine()))
    width: int = 640
    height: int = 480
    rate: float = 30.0
    seed: int = 0
    root: tuple[float, float] = (0.22, 0.0)
    """Place of the root: from the left edge, and below the middle row."""
    length: float = 0.55
    half_thickness: tuple[float, float, float] = (0.045, 0.022, 0.014)
    """At the root, where the fin begins and at the tip."""
    yaw: float = 0.0
    water: float = 180.0
    tail: float = 60.0
    """Grey levels."""
    texture: float = 4.0
    tiles: float = 0.0
    """Darkness of the joints of a tiled floor, in grey levels."""
    noise: float = 4.0
    flicker: float = 0.0
    exposure: float = 0.004
    read_out: float = 0.0
    """Time from the first to the last row [s]."""
    waves: float = 0.0
    """Displacement along each direction, rms [px]."""
    caustics: float = 0.0
    lens: float = 0.0
    """Relative displacement at the corners."""
    tilt: float = 0.0
    """Angle of the camera against the plane of the tail, towards the tip [rad]."""
    aspect: float = 1.0
    """Height of a pixel relative to its width."""
    bend: float = 0.0
    """Change of direction along the fin at its highest speed [rad]."""
    top_rate: float = 5.3
    """Speed of the fin at which it bends by `bend` [rad/s]."""
    lost: float = 0.0
    """Fraction of frames that are lost."""
    glare: tuple[float, float, float] | None = None
    """Column and row of a mirrored lamp, and its radius, as fractions of the width."""
    bubbles: int = 0
    things: tuple[Thing, ...] = ()
    knock: Knock = field(default_factory=lambda: Knock(math.inf))
    torn: float = 0.0
    """Fraction of the tail's length that is missing at the tip."""
    brightness: float = 1.0
    repeated: tuple[float, float] = (math.inf, math.inf)
    """Times [s] between which the camera repeats one picture."""


class Shot(NamedTuple):
    """One frame."""

    time: float
    """Middle of the exposure of the middle row [s]."""
    picture: NDArray[np.uint8]


class FilmedTail:
    """Camera above a tail."""

    def __init__(self, film: Film) -> None:
        self.film = film
        self._random = np.random.default_rng(film.seed)
        w, h = film.width, film.height
        self._centre = np.array([0.5 * (w - 1), 0.5 * (h - 1)])
        self._noise = (
            film.noise * self._random.standard_normal((h + 256, w + 256), np.float32)
        ).astype(np.float32)
        self._waves = self._plane_waves(6, (60 / 640 * w, 250 / 640 * w), (0.5, 3.0))
        self._light = self._plane_waves(8, (40 / 640 * w, 120 / 640 * w), (1.0, 4.0))
        self._floor = self._make_floor()
        grid = np.meshgrid(np.arange(0.0, w + 8, 8), np.arange(0.0, h + 8, 8))
        self._grid = np.stack([g.ravel() for g in grid], axis=1)
        self._grid_shape = grid[0].shape
        self._bubbles = self._random.uniform(0.0, 1.0, (film.bubbles, 4))

    def alpha(self, time: float | Floats) -> Floats:
        """Return the true fin angle [rad]."""
        return np.asarray(self.film.motion(np.asarray(time, np.float64)))

    def shots(self, begin: float, end: float) -> Iterator[Shot]:
        shot = None
        for number in range(math.ceil(begin * self.film.rate), math.floor(end * self.film.rate)):
            if self._random.uniform() >= self.film.lost:
                time = number / self.film.rate
                first, last = self.film.repeated
                if shot is None or not first <= time < last:
                    shot = Shot(time, self.picture(time))
                yield shot._replace(time=time)

    def picture(self, time: float) -> NDArray[np.uint8]:
        film = self.film
        w, h = film.width, film.height
        picture = self._floor
        if film.waves or time >= film.knock.time:
            picture = self._moved_floor(time)
        cover = self._cover(time)
        if cover is not None:
            left, top, covered = cover
            part = np.s_[top : top + covered.shape[0], left : left + covered.shape[1]]
            picture = picture.copy()
            picture[part] += (film.tail - picture[part]) * covered
        elif picture is self._floor:
            picture = picture.copy()
        self._disturb(picture, time)
        if film.caustics:
            picture += film.caustics * self._field(self._light, time)
        if film.flicker:
            rows = time + film.read_out * (np.arange(h) / h - 0.5)
            picture *= (1.0 + film.flicker * np.sin(math.tau * 100.0 * rows + 1.0)).astype(
                np.float32
            )[:, None]
        if film.brightness != 1.0:
            picture *= np.float32(film.brightness)
        if film.noise:
            y, x = self._random.integers(256, size=2)
            picture += self._noise[y : y + h, x : x + w]
        if film.glare is not None:
            x, y, radius = (round(16 * w * value) for value in film.glare)
            cv2.circle(picture, (x, y), radius, 255.0, -1, shift=4)
        return np.clip(picture + 0.5, 0.0, 255.0).astype(np.uint8)

    def midline(self, alpha: Floats, rate: Floats) -> Floats:
        """Return points (n, 48, 2) of the midline in tail lengths for fin angles of shape (n,)."""
        along = (np.arange(_STATIONS - 1) + 0.5) / (_STATIONS - 1)
        bend = (self.film.bend * np.clip(rate / self.film.top_rate, -1.5, 1.5))[:, None]
        part = np.minimum(along / FIN_FROM, 1.0)
        on_fin = np.maximum(along - FIN_FROM, 0.0) / (1.0 - FIN_FROM)
        angle = (alpha[:, None] - 0.5 * bend) * part * (2.0 - part) + bend * on_fin
        steps = np.stack([np.cos(angle), np.sin(angle)], axis=2) / (_STATIONS - 1)
        return np.concatenate([np.zeros((len(alpha), 1, 2)), np.cumsum(steps, axis=1)], axis=1)

    def _outline(self, times: Floats) -> Floats:
        """Return the polygon (m, 2) in pixels of an ideal camera; corner k is seen at times[k]."""
        film = self.film
        # Without a rolling shutter, all corners are seen at one moment.
        moments, number = np.unique(times, return_inverse=True)
        alpha = self.alpha(moments)
        points = self.midline(alpha, (self.alpha(moments + 1e-3) - alpha) / 1e-3)
        end = _STATIONS - 1
        upper = np.minimum(np.arange(_STATIONS), round((1.0 - film.torn) * end))
        place = np.concatenate([upper, upper[::-1]])
        slope = (
            points[number, np.minimum(place + 1, end)] - points[number, np.maximum(place - 1, 0)]
        )
        normal = np.stack([-slope[:, 1], slope[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        half = np.interp(place / end, [0.0, FIN_FROM, 1.0], film.half_thickness) / film.length
        half[_STATIONS:] *= -1.0
        outline = points[number, place] + half[:, None] * normal
        turn = np.array(
            [[math.cos(film.yaw), -math.sin(film.yaw)], [math.sin(film.yaw), math.cos(film.yaw)]]
        )
        root = np.array(
            [film.root[0] * film.width - 0.5, self._centre[1] + film.root[1] * film.width]
        )
        return root + film.length * film.width * outline @ turn.T

    def _project(self, points: Floats, time: float) -> Floats:
        """Return where points of an ideal camera are seen [px]."""
        film = self.film
        offset = points - self._centre
        knock = film.knock
        if time >= knock.time:
            c, s = knock.zoom * math.cos(knock.turn), knock.zoom * math.sin(knock.turn)
            offset = offset @ np.array([[c, s], [-s, c]]) + film.width * np.array(knock.shift)
        if film.tilt:
            depth = 1.0 + math.sin(film.tilt) * offset[:, :1] / film.width
            offset = offset * (math.cos(film.tilt), 1.0) / depth
        if film.lens:
            radius = np.linalg.norm(offset, axis=1, keepdims=True) / math.hypot(*self._centre)
            offset = offset * (1.0 + film.lens * radius**2)
        seen = self._centre + offset / (1.0, film.aspect)
        if film.waves:
            seen = seen + self._displacement(seen, time)
        return np.asarray(seen)

    def _cover(self, time: float) -> tuple[int, int, NDArray[np.float32]] | None:
        """Return the fraction of each pixel that the tail covers, and the place of that part."""
        film = self.film
        count = 1 if film.exposure <= 0.002 else 5
        polygons, rows = [], np.full(2 * _STATIONS, 0.5 * film.height)
        for share in (np.arange(count) + 0.5) / count - 0.5:
            moment = time + share * film.exposure
            rounds = 2 if polygons else 3
            for _ in range(rounds if film.read_out else 1):
                times = moment + film.read_out * (rows / film.height - 0.5)
                polygon = self._project(self._outline(times), moment)
                rows = polygon[:, 1]
            polygons.append(polygon)
        corners = np.concatenate(polygons)
        left, top = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
        right = min(int(corners[:, 0].max()) + 2, film.width)
        bottom = min(int(corners[:, 1].max()) + 2, film.height)
        if right <= left or bottom <= top:
            return None
        shape = (bottom - top, right - left)
        total = np.zeros((SAMPLES * shape[0], SAMPLES * shape[1]), np.uint8)
        level = 255 // count
        for polygon in polygons:
            fine = np.zeros_like(total)
            places = (polygon - (left, top) + 0.5) * SAMPLES - 0.5
            cv2.fillPoly(fine, [np.rint(places * 256).astype(np.int32)], level, shift=8)
            cv2.add(total, fine, total)
        covered = cv2.resize(total, shape[::-1], interpolation=cv2.INTER_AREA)
        return int(left), int(top), covered / np.float32(255)

    def _make_floor(self) -> NDArray[np.float32]:
        """Return the floor, which does not move, with the fish's body."""
        film = self.film
        w, h = film.width, film.height
        grain = self._random.standard_normal((h // 8 + 2, w // 8 + 2)).astype(np.float32)
        floor = film.water + film.texture * cv2.resize(grain, (w, h), interpolation=cv2.INTER_CUBIC)
        if film.tiles:
            side = w // 6
            for place in range(side // 3, max(w, h), side):
                floor[:, place : place + max(2, w // 200)] -= film.tiles
                floor[place : place + max(2, w // 200)] -= film.tiles
        half = film.half_thickness[0] * w * SAMPLES
        mask = np.zeros((h * SAMPLES, w * SAMPLES), np.uint8)
        root = np.array([film.root[0] * w, 0.5 * h + film.root[1] * w]) * SAMPLES
        along = np.array([math.cos(film.yaw), math.sin(film.yaw)])
        across = np.array([-along[1], along[0]])
        back = root - 0.4 * w * SAMPLES * along
        corners = np.stack(
            [
                root + half * across,
                root - half * across,
                back - 1.1 * half * across,
                back + 1.1 * half * across,
            ]
        )
        if film.lens or film.tilt or film.aspect != 1.0:
            corners = (self._project(corners / SAMPLES - 0.5, -1.0) + 0.5) * SAMPLES
        cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], 255)
        covered = cv2.resize(mask, (w, h), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        return floor + (film.tail - floor) * covered

    def _moved_floor(self, time: float) -> NDArray[np.float32]:
        film = self.film
        seen = self._grid
        if film.waves:
            seen = seen - self._displacement(seen, time)
        knock = film.knock
        if time >= knock.time:
            c, s = math.cos(knock.turn) / knock.zoom, math.sin(knock.turn) / knock.zoom
            offset = seen - self._centre - film.width * np.array(knock.shift)
            seen = self._centre + offset @ np.array([[c, -s], [s, c]])
        size = (self._grid_shape[1] * 8, self._grid_shape[0] * 8)
        maps = []
        for axis in (0, 1):
            coarse = seen[:, axis].reshape(self._grid_shape).astype(np.float32)
            # A resize is centred on pixels of 8; the grid's points are 8 apart from pixel 0.
            shift = np.float32([[8, 0, 0], [0, 8, 0]])
            maps.append(
                cv2.warpAffine(coarse, shift, size, flags=cv2.INTER_LINEAR)[
                    : film.height, : film.width
                ]
            )
        return cv2.remap(
            self._floor, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )

    def _plane_waves(
        self, count: int, lengths: tuple[float, float], rates: tuple[float, float]
    ) -> Floats:
        """Return wave numbers (2), angular rate, phase and amplitudes (2) of plane waves."""
        draw = self._random.uniform
        first, waves = draw(0.0, math.pi), []
        for index in range(count):
            direction, length = first + math.pi * 3 * index / count, draw(*lengths)
            number = math.tau / length * np.array([math.cos(direction), math.sin(direction)])
            way = np.array([math.cos(direction), math.sin(direction)])
            waves.append([*number, math.tau * draw(*rates), draw(0.0, math.tau), *way])
        return np.array(waves)

    def _displacement(self, points: Floats, time: float) -> Floats:
        waves = self._waves
        heave = np.sin(points @ waves[:, :2].T + waves[:, 2] * time + waves[:, 3])
        return np.asarray(self.film.waves * 2.0 / math.sqrt(len(waves)) * heave @ waves[:, 4:])

    def _field(self, waves: Floats, time: float) -> NDArray[np.float32]:
        """Return a pattern of light, rms 1, of the size of the picture."""
        w, h = self.film.width, self.film.height
        points = np.stack(np.meshgrid(np.arange(w // 8), np.arange(h // 8)), axis=2) * 8.0 + 3.5
        heave = np.sin(points @ waves[:, :2].T + waves[:, 2] * time + waves[:, 3]).sum(axis=2)
        pattern = (heave * math.sqrt(2.0 / len(waves))).astype(np.float32)
        return np.asarray(cv2.resize(pattern, (w, h), interpolation=cv2.INTER_LINEAR))

    def _disturb(self, picture: NDArray[np.float32], time: float) -> None:
        """Draw bubbles and things."""
        film = self.film
        w, h = film.width, film.height
        for x, y, speed, size in self._bubbles:
            centre = (
                round(16 * w * ((x + 0.1 * speed * time) % 1.0)),
                round(16 * h * ((y + 0.3 * time) % 1.0)),
            )
            cv2.circle(picture, centre, round(16 * w * (0.004 + 0.006 * size)), 235.0, -1, shift=4)
        for thing in film.things:
            x, y = (a + b * time for a, b in zip(thing.start, thing.velocity, strict=True))
            cv2.ellipse(
                picture,
                (round(16 * w * x), round(16 * (0.5 * h + w * y))),
                (round(16 * w * thing.half_axes[0]), round(16 * w * thing.half_axes[1])),
                math.degrees(thing.direction), 0, 360,
                film.tail if thing.level is None else thing.level, -1, shift=4,
            )  # fmt: skip
