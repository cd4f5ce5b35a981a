"""Simulated camera, which draws the tail for a fin angle and a light.

The fish's axis runs along the rows of the picture, its head to the left. The tail is a skeleton
that bends evenly from the body to the fin's root, and a straight fin at the angle α to the axis, as
docs/how-to/camera.md defines it; α > 0 bends the tail towards the higher rows.
"""

import math
from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from fishd.core.camera_frames import (
    TIME_TOLERANCE_S,
    Frame,
    FrameHistory,
    Pixels,
    Stack,
    StackSettings,
)
from fishd.core.schema import note, unit
from fishd.core.signals import Truth

PIVOT, LENGTH = 0.14, 0.74
"""Column of the tail's root and length of the tail, as fractions of the middle square's side."""
SKELETON = 0.3
"""Length of the skeleton, as a fraction of the tail's length; the rest is the fin."""
ROOT_HALF_THICKNESS, TIP_HALF_THICKNESS = 0.055, 0.018
"""Half of the tail's thickness at its root and at its tip, as fractions of that side."""
WATER_LEVEL = 180.0
"""Grey level of the water."""
_NOISE_SHIFTS = 252
"""Number of places in the pool of noise at which a picture may begin, in each direction."""
_RIPPLE_LENGTH = 0.1
"""Length of the caustics' ripples, as a fraction of the middle square's side."""
_PATTERN_VELOCITIES = ((0.31, 0.17), (-0.23, 0.29))
"""Velocities of the two patterns that add up to the caustics [sides/s]."""
_LIGHT_PERIOD = 23.0
"""Period of the slow drift of the light [s]."""

Array = NDArray[np.float32]


class SimulatedCameraSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Timing, optics and light of a simulated camera; the defaults are the rig `default`."""

    rate: Annotated[
        Annotated[float, Meta(gt=0, le=1000)] | None,
        unit("1/s", "Frames per second; null: one for each tick, in phase with it."),
    ] = None
    latency: Annotated[
        float,
        unit("s", "Time from exposure until the frame is available.", ge=0, le=1),
    ] = 0.03
    jitter: Annotated[float, unit("s", "Standard deviation of the latency.", ge=0, le=0.2)] = 0.0
    exposure: Annotated[float, unit("s", "Exposure time.", ge=0, le=0.2)] = 0.01
    noise: Annotated[
        float, unit("1", "Standard deviation of a pixel's noise, in grey levels.", ge=0, le=100)
    ] = 4.0
    contrast: Annotated[
        float, unit("1", "Grey level of the water minus that of the tail.", gt=0, le=170)
    ] = 100.0
    caustics: Annotated[
        float,
        unit(
            "1", "Standard deviation of the moving pattern of light, in grey levels.", ge=0, le=100
        ),
    ] = 0.0
    light_drift: Annotated[
        float, unit("1", "Relative amplitude of the slow change of the light.", ge=0, lt=1)
    ] = 0.0
    side_light: Annotated[
        float,
        unit(
            "1",
            "Difference in grey level between the two sides of the axis.",
            ge=-100,
            le=100,
        ),
    ] = 0.0
    off_axis: Annotated[
        float,
        unit("px", "Distance of the fish's axis from the middle of the frame.", ge=-40, le=40),
    ] = 0.0
    tilt: Annotated[
        float,
        unit(
            "rad", "Angle of the fish's axis to the frame's rows.", ge=-math.pi / 8, le=math.pi / 8
        ),
    ] = 0.0
    seed: Annotated[int, note("Seed of the random numbers for noise, light and jitter.", ge=0)] = 0


DEFAULT = SimulatedCameraSettings()


class TailPainter:
    """Painter of pictures, each with independent noise."""

    def __init__(
        self, settings: SimulatedCameraSettings, width: int, height: int | None = None
    ) -> None:
        """width, height: size of a picture [px]; without a height, it is a square"""
        self._settings = settings
        height = height or width
        self._shape, self._side = (height, width), min(height, width)
        side = self._side
        self._random = np.random.default_rng(settings.seed)
        cos, sin = math.cos(settings.tilt), math.sin(settings.tilt)
        x = np.arange(width) - 0.5 * (width - 1)
        y = np.arange(height)[:, None] - 0.5 * (height - 1) - settings.off_axis
        self._distance = (y * cos - x * sin).astype(np.float32)
        """Distance of each pixel from the axis, positive below it [px]."""
        place = (x * cos + y * sin + 0.5 * (side - 1) - PIVOT * side) / (LENGTH * side)
        self._is_body = (place < 0.0) & (np.abs(self._distance) < ROOT_HALF_THICKNESS * side)
        is_tail = (place >= 0.0) & (place <= 1.0)
        columns = np.flatnonzero(is_tail.any(axis=0))
        self._tail = slice(columns[0], columns[-1] + 1)
        if not settings.tilt:  # one row stands for all
            place, is_tail = place[:1], is_tail[:1]
        place, is_tail = place[:, self._tail].clip(0.0, 1.0), is_tail[:, self._tail]
        skeleton = np.minimum(place, SKELETON)
        bend = LENGTH * side * (place - skeleton + skeleton**2 / (2.0 * SKELETON))
        self._bend = bend.astype(np.float32)
        """Lateral shift of the tail, at each pixel's place along it, for tan α = 1 [px]."""
        thickness = ROOT_HALF_THICKNESS + (TIP_HALF_THICKNESS - ROOT_HALF_THICKNESS) * place
        self._half = (side * thickness * is_tail).astype(np.float32)
        middle, reach = 0.5 * (height - 1) + settings.off_axis, abs(sin) * side
        self._rows = middle - reach, middle + reach
        """Rows between which the fish lies at rest [px]."""
        self._still = self._background()
        self._noise = self._pool(settings.noise)
        self._caustics = [self._ripples() for _ in _PATTERN_VELOCITIES] if settings.caustics else []
        self._phase = float(self._random.uniform(0.0, math.tau))
        self._picture = np.empty(self._shape, np.float32)

    def paint(self, alpha: float, alpha_rate: float, time: float) -> Pixels:
        """Return the picture at `time` [s] of a tail at α [rad] that moves with α̇ [rad/s]."""
        settings, side, picture = self._settings, self._side, self._picture
        height, width = self._shape
        np.copyto(picture, self._still)
        self._draw_tail(picture, alpha, alpha_rate)
        for pattern, (across, down) in zip(self._caustics, _PATTERN_VELOCITIES, strict=False):
            x, y = int(across * side * time) % width, int(down * side * time) % height
            picture += pattern[y : y + height, x : x + width]
        if settings.light_drift:
            swing = math.sin(math.tau * time / _LIGHT_PERIOD + self._phase)
            picture *= 1.0 + settings.light_drift * swing
        if settings.noise:
            y, x = self._random.integers(_NOISE_SHIFTS, size=2).tolist()
            picture += self._noise[y : y + height, x : x + width]
        np.clip(picture, 0.0, 255.0, out=picture)
        return picture.astype(np.uint8)

    def _draw_tail(self, picture: Array, alpha: float, alpha_rate: float) -> None:
        """Darken each pixel by the fraction of it that the tail covers during the exposure.

        The tail's edge is a ramp, as wide as one pixel plus the motion during the exposure.
        """
        slope = math.tan(alpha)
        motion = alpha_rate * (1.0 + slope * slope) * self._settings.exposure
        longest = float(self._bend.max())
        room = ROOT_HALF_THICKNESS * self._side + abs(motion) * longest + 2.0
        first, last = self._rows
        rows = slice(
            max(0, int(first + min(0.0, slope * longest) - room)),
            max(0, int(last + max(0.0, slope * longest) + room)),
        )
        same = slice(None) if len(self._bend) == 1 else rows
        bend, half = self._bend[same], self._half[same]
        sharp = 1.0 / np.sqrt(1.0 + (motion * bend) ** 2)
        off = (self._distance[rows, self._tail] - slope * bend) * sharp
        half = half * sharp
        covered = np.clip(off + (half + 0.5), 0.0, 1.0)
        covered -= np.clip(off - (half - 0.5), 0.0, 1.0)
        picture[rows, self._tail] -= self._settings.contrast * covered

    def _background(self) -> Array:
        """Return the picture of the water with its side light, and of the body, which is still.

        It includes 0.5 grey levels, because levels are rounded down later.
        """
        settings, side = self._settings, self._side
        still = WATER_LEVEL + settings.side_light / side * self._distance + 0.5
        return (still - settings.contrast * self._is_body).astype(np.float32)

    def _pool(self, deviation: float) -> Array:
        height, width = self._shape
        shape = height + _NOISE_SHIFTS, width + _NOISE_SHIFTS
        return (deviation * self._random.standard_normal(shape)).astype(np.float32)

    def _ripples(self) -> Array:
        """Return a smooth random pattern that repeats after the picture in both directions."""
        # Relative to the frequency of a ripple.
        down, across = (np.fft.fftfreq(n, 1.0 / (self._side * _RIPPLE_LENGTH)) for n in self._shape)
        square = down[:, None] ** 2 + across[None, :] ** 2
        spectrum = np.fft.fft2(self._random.standard_normal(self._shape))
        pattern = np.fft.ifft2(spectrum * square * np.exp(-square)).real
        pattern *= self._settings.caustics / math.sqrt(len(_PATTERN_VELOCITIES)) / pattern.std()
        return np.tile(pattern, (2, 2)).astype(np.float32)


class Tail(NamedTuple):
    """Position and velocity of the tail."""

    time: float
    """Time [s]."""
    alpha: float
    """Fin angle [rad]."""
    alpha_rate: float
    """Angular velocity of the fin [rad/s]."""


class SimulatedCamera:
    """Camera that takes its frames from the fin angle over time."""

    def __init__(
        self, settings: SimulatedCameraSettings, width: int, height: int | None = None
    ) -> None:
        """width, height: size of a picture [px]; without a height, it is a square"""
        self._settings = settings
        self._painter = TailPainter(settings, width, height)
        self._random = np.random.default_rng([settings.seed, 1])
        self._phase = float(self._random.uniform())
        """Phase of the frames relative to time zero, in periods."""
        self._available = -math.inf

    def frames(self, before: Tail, after: Tail) -> list[Frame]:
        """Return the frames exposed after `before` and up to `after`.

        Between the two, the fin angle is the cubic polynomial through their angles and rates.
        """
        frames = []
        for time in self._times(before.time, after.time):
            alpha, alpha_rate = _interpolate(before, after, time)
            pixels = self._painter.paint(alpha, alpha_rate, time)
            latency = self._settings.latency
            if self._settings.jitter:
                latency += float(self._random.normal(0.0, self._settings.jitter))
            self._available = max(self._available, time + max(0.0, latency))
            frames.append(Frame(time, self._available, pixels))
        return frames

    def _times(self, begin: float, end: float) -> list[float]:
        rate = self._settings.rate
        if rate is None:  # frames are available when a tick begins
            tick = end - begin
            ticks = math.floor((self._settings.latency + TIME_TOLERANCE_S) / tick)
            return [end - max(0.0, self._settings.latency - ticks * tick)]
        first = math.floor(begin * rate - self._phase) + 1
        last = math.floor(end * rate - self._phase)
        return [(number + self._phase) / rate for number in range(first, last + 1)]


def _interpolate(before: Tail, after: Tail, time: float) -> tuple[float, float]:
    """Return angle and rate on the cubic Hermite polynomial through both ends."""
    h = after.time - before.time
    s = (time - before.time) / h
    left, right = before.alpha_rate * h, after.alpha_rate * h
    rise = after.alpha - before.alpha
    square = 3.0 * rise - 2.0 * left - right
    cube = left + right - 2.0 * rise
    alpha = before.alpha + s * (left + s * (square + s * cube))
    return alpha, (left + s * (2.0 * square + 3.0 * s * cube)) / h


class SimulatedSight:
    """Simulated camera above one fish; call `look` in every tick from the first one on."""

    def __init__(
        self,
        camera: SimulatedCameraSettings,
        stack: StackSettings,
        tick: float,
        truth: Callable[[], Truth],
    ) -> None:
        """
        tick: period of the loop [s]
        truth: returns the current state of the fish
        """
        self._camera = SimulatedCamera(camera, stack.size)
        self._history = FrameHistory(stack)
        self._tick, self._truth = tick, truth
        self._before: Tail | None = None

    def look(self, time: float) -> Stack | None:
        """Return the stack for a policy at a tick [s]; None before there are enough frames."""
        now = self._truth()
        after = Tail(time, now.alpha, now.alpha_rate)
        before = self._before or Tail(time - self._tick, now.alpha, 0.0)
        if after.time > before.time:
            self._before = after
            for frame in self._camera.frames(before, after):
                self._history.add(frame)
        return self._history.stack(time)
