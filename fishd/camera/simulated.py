"""Simulated camera, which draws the tail for a fin angle and a light.

The fish's axis runs along the rows of the picture, its head to the left; a fin angle α > 0 bends
the tail towards the higher rows. Each column of pixels crosses the tail in one strip.
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
"""Column of the tail's root and length of the tail, as fractions of the picture's width."""
ROOT_HALF_THICKNESS, TIP_HALF_THICKNESS = 0.055, 0.018
"""Half of the tail's thickness at its root and at its tip, as fractions of the width."""
WATER_LEVEL = 180.0
"""Grey level of the water."""
_POOL_SIZE = 4
"""Height and width of the pool of noise, in picture sizes."""
_RIPPLE_LENGTH = 0.1
"""Length of the caustics' ripples, as a fraction of the width."""
_PATTERN_VELOCITIES = ((0.31, 0.17), (-0.23, 0.29))
"""Velocities of the two patterns that add up to the caustics [widths/s]."""
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
        unit("s", "Time from the middle of the exposure until the frame is available.", ge=0, le=1),
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
WEB = SimulatedCameraSettings(
    rate=30.0,
    latency=0.05,
    jitter=0.005,
    exposure=0.02,
    noise=6.0,
    caustics=12.0,
    side_light=20.0,
    off_axis=3.0,
    tilt=0.02,
)
"""Settings of a cheap USB camera on a stand."""


class TailPainter:
    """Painter of pictures, each with independent noise."""

    def __init__(self, settings: SimulatedCameraSettings, size: int) -> None:
        """size: height and width of a picture [px]"""
        self._settings = settings
        self._size = size
        self._random = np.random.default_rng(settings.seed)
        columns = np.arange(size, dtype=np.float32)
        along = np.clip((columns - PIVOT * size) / (LENGTH * size), 0.0, None)
        first, last = round(PIVOT * size), round((PIVOT + LENGTH) * size)
        self._tail = slice(first, last)
        place = along[self._tail]
        self._bend = (LENGTH * size * 0.5 * place * (1.0 + place)).astype(np.float32)
        """Lateral shift of each column of the tail for tan α = 1 [px]."""
        self._half = (
            size * (ROOT_HALF_THICKNESS + (TIP_HALF_THICKNESS - ROOT_HALF_THICKNESS) * place)
        ).astype(np.float32)
        axis = (
            0.5 * (size - 1)
            + settings.off_axis
            + math.tan(settings.tilt) * (columns - 0.5 * (size - 1))
        )
        self._distance = (columns[:, None] - axis[None, :]).astype(np.float32)
        """Distance of each pixel from the axis, positive below it, shape (size, size) [px]."""
        self._still = self._background()
        self._noise = self._pool(settings.noise)
        self._caustics = [self._ripples() for _ in _PATTERN_VELOCITIES] if settings.caustics else []
        self._phase = float(self._random.uniform(0.0, math.tau))
        self._picture = np.empty((size, size), np.float32)

    def paint(self, alpha: float, alpha_rate: float, time: float) -> Pixels:
        """Return the picture at `time` [s] of a tail at α [rad] that moves with α̇ [rad/s]."""
        settings, size, picture = self._settings, self._size, self._picture
        np.copyto(picture, self._still)
        picture[:, self._tail] -= settings.contrast * self._coverage(alpha, alpha_rate)
        for pattern, (across, down) in zip(self._caustics, _PATTERN_VELOCITIES, strict=False):
            x, y = int(across * size * time) % size, int(down * size * time) % size
            picture += pattern[y : y + size, x : x + size]
        if settings.light_drift:
            swing = math.sin(math.tau * time / _LIGHT_PERIOD + self._phase)
            picture *= 1.0 + settings.light_drift * swing
        if settings.noise:
            y, x = self._random.integers(size * (_POOL_SIZE - 1), size=2).tolist()
            picture += self._noise[y : y + size, x : x + size]
        np.clip(picture, 0.0, 255.0, out=picture)
        return picture.astype(np.uint8)

    def _coverage(self, alpha: float, alpha_rate: float) -> Array:
        """Return the fraction of each pixel that the tail covers during the exposure.

        The tail's edge is a ramp, as wide as one pixel plus the motion during the exposure.
        """
        slope = math.tan(alpha)
        motion = alpha_rate * (1.0 + slope * slope) * self._settings.exposure
        sharp = 1.0 / np.sqrt(1.0 + (motion * self._bend) ** 2)
        off = (self._distance[:, self._tail] - slope * self._bend) * sharp
        half = self._half * sharp
        upper = np.clip(off + (half + 0.5), 0.0, 1.0)
        covered: Array = upper - np.clip(off - (half - 0.5), 0.0, 1.0)
        return covered

    def _background(self) -> Array:
        """Return the picture of the water, the side light and the body, which does not move.

        It includes 0.5 grey levels, because levels are rounded down later.
        """
        settings, size = self._settings, self._size
        still = WATER_LEVEL + settings.side_light / size * self._distance + 0.5
        body = np.abs(self._distance[:, : self._tail.start]) < size * ROOT_HALF_THICKNESS
        still[:, : self._tail.start] -= settings.contrast * body
        return still.astype(np.float32)

    def _pool(self, deviation: float) -> Array:
        side = self._size * _POOL_SIZE
        return (deviation * self._random.standard_normal((side, side))).astype(np.float32)

    def _ripples(self) -> Array:
        """Return a smooth random pattern with a period of `size` pixels in both directions."""
        size = self._size
        # Relative to the frequency of a ripple.
        waves = np.fft.fftfreq(size, 1.0 / (size * _RIPPLE_LENGTH))
        square = waves[:, None] ** 2 + waves[None, :] ** 2
        spectrum = np.fft.fft2(self._random.standard_normal((size, size)))
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

    def __init__(self, settings: SimulatedCameraSettings, size: int) -> None:
        """size: height and width of a frame [px]"""
        self._settings = settings
        self._painter = TailPainter(settings, size)
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
