"""Figures of the fin angle, or of a fish that swims by itself, in a video, with its pictures."""

import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.camera.tail.beats import Beat
from fishd.core.camera_frames import Pixels
from fishd.core.tail_reading import TailReading
from fishd.lab.drawing import BLUE, GREEN, ORANGE, open_figure, plain
from fishd.lab.free_fish import Seen, Swim
from fishd.lab.run_traces import MIN_ANGLE_SPAN, limits

Array = NDArray[np.float64]
_MAX_TIMES = 20_000
"""Largest number of times for which the fin angle is drawn as a line, not as its range."""


class Example(NamedTuple):
    """Picture and what was measured in it."""

    picture: Pixels
    reading: TailReading


def draw_fin_angle(
    title: str,
    times: Array,
    angles: Array,
    beats: Sequence[Beat],
    examples: Sequence[Example],
    path: str | os.PathLike[str],
) -> None:
    """Write the figure; raises `FishdError` where this fails, and `MissingPackage`.

    times, angles: of the pictures; the fin angle is NaN where it is unknown [s, rad]
    examples: pictures to draw
    """
    with open_figure(path, (8.0, 6.5 if examples else 4.0)) as figure:
        figure.suptitle(plain(title), x=0.01, ha="left", fontsize=10)
        parts: Any = figure.subfigures(2, 1, height_ratios=(3 if examples else 0.1, 4))
        upper, lower = parts
        for index, example in enumerate(examples):
            reading = example.reading
            axis = upper.add_subplot(1, len(examples), index + 1)
            _draw_picture(axis, example.picture, np.array(reading.midline))
            axis.set_title(f"{reading.time:.3f} s: {reading.alpha or 0.0:+.3f} rad")
        angle, top = lower.subplots(2, 1, sharex=True)
        angle.axhline(0.0, color="0.85", linewidth=0.6)
        _draw_curve(angle, times, angles)
        angle.set_ylim(*limits(MIN_ANGLE_SPAN, angles))
        angle.set_ylabel("fin angle (rad)")
        maxima = np.array([(beat.time, beat.alpha_max) for beat in beats]).reshape(-1, 2)
        top.plot(*maxima.T, ".", color=ORANGE)
        top.set_ylim(0.0, limits(MIN_ANGLE_SPAN, maxima[:, 1])[1])
        top.set_ylabel("its maxima (rad)")
        top.set_xlabel("time in the video (s)")


def draw_swim(
    title: str,
    swim: Swim,
    example: tuple[Pixels, Seen] | None,
    path: str | os.PathLike[str],
) -> None:
    """Write the figure of a fish that swims by itself; raises as `draw_fin_angle`.

    example: picture to draw, and the fish in it
    """
    with open_figure(path, (8.0, 8.0 if example else 5.0)) as figure:
        figure.suptitle(plain(title), x=0.01, ha="left", fontsize=10)
        parts: Any = figure.subfigures(2, 1, height_ratios=(4 if example else 0.1, 4))
        if example:
            axis = parts[0].add_subplot()
            axis.plot(*swim.places.T / swim.scale, color=ORANGE, linewidth=0.9)
            _draw_picture(axis, example[0], example[1].midline)
            axis.set_title(f"{example[1].time:.3f} s")
        tail, speed = parts[1].subplots(2, 1, sharex=True)
        _draw_curve(tail, swim.times, swim.tail)
        tail.plot(*swim.maxima.T, ".", color=ORANGE)
        tail.set_ylabel(f"tail across ({swim.unit})")
        _draw_curve(speed, swim.times, swim.speed)
        speed.set_ylabel(f"speed ({swim.unit}/s)")
        speed.set_xlabel("time in the video (s)")


def _draw_picture(axis: Any, picture: Pixels, midline: Array) -> None:
    height, width = picture.shape
    axis.imshow(picture, cmap="gray", vmin=0, vmax=255)
    axis.plot(*midline.T, color=GREEN, linewidth=1.5)
    axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])


def _draw_curve(axis: Any, times: Array, values: Array) -> None:
    """Draw values over the times of pictures; of many, their range."""
    if len(times) <= _MAX_TIMES:
        axis.plot(times, values, color=BLUE, linewidth=0.9)
        return
    edges = np.linspace(0, len(times), _MAX_TIMES // 10 + 1).astype(int)[:-1]
    low, high = (part.reduceat(values, edges) for part in (np.fmin, np.fmax))
    axis.fill_between(times[edges], low, high, color=BLUE, linewidth=0)
