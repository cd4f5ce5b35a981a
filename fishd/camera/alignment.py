"""How a camera stands over the fish, judged by what moves in its frames, and what would be better.

Frames should show the fish's axis along their middle row, its head to the left, its tail inside.
"""

import math
from typing import NamedTuple

import numpy as np

from fishd.camera.axis import Axis, Floats, Motion, find_axis, likeness
from fishd.camera.settings import CameraSettings, Square

NEAR = 0.5
"""An axis is in the middle when it is no further off [px]."""
LEVEL = math.radians(0.5)
"""It is level when its tilt is no more [rad]."""
_CLEARER = 1.3
"""Motion is upright when it is so much more its own mirror image that way."""
_EDGE = 0.1
"""Motion is cut off when a tenth of an edge shows more than this share of the strongest."""


class Place(NamedTuple):
    """Where the motion is: the rows and columns that hold nine tenths of it [px]."""

    top: int
    bottom: int
    left: int
    right: int


class Alignment(NamedTuple):
    """How a camera stands over the fish."""

    motion: Motion
    place: Place
    good: bool
    advice: tuple[str, ...]
    """What to do, a line each; nothing where all is well."""
    settings: dict[str, object]
    """What to write into the camera's settings, by dotted key."""


def judge(motion: Motion, picture: tuple[int, int], settings: CameraSettings) -> Alignment:
    """Judge the motion in frames.

    picture: height and width of the camera's whole pictures as frames are cut from them [px]
    settings: of the camera
    """
    place = _place(motion.energy)
    edges = _cut_off(motion.energy)
    advice = [f"the motion is cut off at {' and '.join(edges)}: show more around the tail"] * bool(
        edges
    )
    better: dict[str, object] = {}
    if turn := _turn(motion):
        better["picture.rotate"] = (settings.picture.rotate + turn) % 360
        advice.append(
            "the fish does not lie along the rows of the picture with its head to the left: turn it"
        )
        return Alignment(motion, place, False, tuple(advice), better)
    axis = motion.axis
    if not motion.sure:
        advice.append(
            "the axis lies at the edge of what is looked at, and may be further off or steeper: "
            "turn or move the camera, then align again"
        )
    level, near = abs(axis.tilt) <= LEVEL, abs(axis.offset) <= NEAR
    if settings.source == "simulated":
        if not near:
            better["simulated.off_axis"] = round(settings.simulated.off_axis - axis.offset, 1) + 0.0
        if not level:
            better["simulated.tilt"] = round(settings.simulated.tilt - axis.tilt, 3) + 0.0
    else:
        if not level:
            way = "clockwise" if axis.tilt > 0.0 else "counter-clockwise"
            advice.append(
                f"turn the camera {way}, as seen from behind it, by "
                f"{abs(math.degrees(axis.tilt)):.1f}°"
            )
        if not near:
            crop = _centred(axis, motion.energy.shape[0], picture, settings.picture.crop)
            for name in ("y", "side"):
                value = round(getattr(crop, name), 3)
                if value != round(getattr(settings.picture.crop, name), 3):
                    better[f"picture.crop.{name}"] = value
    good = level and near and motion.sure and not edges
    return Alignment(motion, place, good, tuple(advice), better)


def _centred(axis: Axis, size: int, picture: tuple[int, int], crop: Square) -> Square:
    """The square whose middle row is the axis; a smaller one where that needs more room."""
    height, shorter = picture[0], min(picture)
    side = crop.side * shorter
    half = 0.5 * side / height
    middle = min(max(crop.y, half), 1.0 - half)  # as the picture is truly cut
    middle += axis.offset * side / size / height
    room = 2.0 * min(middle, 1.0 - middle) * height
    return Square(x=crop.x, y=middle, side=max(0.05, min(side, room) / shorter))


def _turn(motion: Motion) -> int:
    """By how many degrees the picture must be turned clockwise for the head to be at the left."""
    energy = motion.energy
    upright = find_axis(np.ascontiguousarray(energy.T))
    if likeness(energy.T, upright) > _CLEARER * likeness(energy, motion.axis):
        return 270 if _behind(energy.T) else 90
    return 0 if _behind(energy) else 180


def _behind(energy: Floats) -> bool:
    """Does the motion grow towards the right, as that of a tail does whose root is at the left?"""
    strength = energy.sum(axis=0)
    moving = np.flatnonzero(strength > 0.05 * strength.max())
    middle = 0.5 * (moving[0] + moving[-1])
    centre = float(strength @ np.arange(len(strength)) / strength.sum())
    return centre >= float(middle)


def _place(energy: Floats) -> Place:
    return Place(*_middle(energy.sum(axis=1)), *_middle(energy.sum(axis=0)))


def _middle(strength: Floats) -> tuple[int, int]:
    """First and last of those that hold nine tenths."""
    share = np.cumsum(strength) / strength.sum()
    return int(np.searchsorted(share, 0.05)), int(np.searchsorted(share, 0.95))


def _cut_off(energy: Floats) -> list[str]:
    """The edges of the picture that motion reaches in strength."""
    limit = _EDGE * float(np.quantile(energy[energy > 0.0], 0.9))
    edges = {
        "the upper edge": energy[:2],
        "the lower edge": energy[-2:],
        "the left edge": energy[:, :2],
        "the right edge": energy[:, -2:],
    }
    return [name for name, edge in edges.items() if float(np.quantile(edge, 0.9)) > limit]
