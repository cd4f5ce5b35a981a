"""Alignment of a camera above the fish, derived from the motion in its frames.

Frames should show the fish's axis along their middle row, its head to the left, its whole tail.
"""

import math
from typing import NamedTuple

import numpy as np

from fishd.camera.axis import Axis, Floats, Motion, compute_likeness, find_axis
from fishd.camera.settings import CameraSettings, Square

MAX_OFFSET_PX = 0.5
"""Largest offset of an axis that counts as centred [px]."""
MAX_TILT_RAD = math.radians(0.5)
"""Largest tilt of an axis that counts as level [rad]."""
_UPRIGHT_LIKENESS_RATIO = 1.15
"""Ratio of the symmetry of the transposed motion to that of the motion, above which the fish lies
along the columns of the picture. It is 1.3 for one that does, with a straight fin, and 0.8 for one
that lies along the rows."""
_EDGE_FRACTION = 0.1
"""Fraction of the 90 % quantile of the motion; the motion is cut off where a tenth of an edge
exceeds it."""


class Place(NamedTuple):
    """Rows and columns that hold nine tenths of the motion [px]."""

    top: int
    bottom: int
    left: int
    right: int


class Alignment(NamedTuple):
    """Result of a check of a camera's alignment."""

    motion: Motion
    place: Place
    is_aligned: bool
    advice: tuple[str, ...]
    """Instructions, one line each; empty where the alignment is good."""
    settings: dict[str, object]
    """New values for the camera's settings, by dotted key."""


def judge(motion: Motion, picture: tuple[int, int], settings: CameraSettings) -> Alignment:
    """Return the alignment that the motion in frames shows.

    picture: height and width of the camera's whole pictures, from which frames are cut [px]
    settings: the camera's settings
    """
    place = _place(motion.energy)
    edges = _edges_reached(motion.energy)
    advice = [f"the motion is cut off at {' and '.join(edges)}: show more around the tail"] * bool(
        edges
    )
    new_settings: dict[str, object] = {}
    if turn := _needed_turn(motion):
        new_settings["picture.rotate"] = (settings.picture.rotate + turn) % 360
        advice.append(
            "the fish does not lie along the rows of the picture with its head to the left: turn it"
        )
        return Alignment(motion, place, False, tuple(advice), new_settings)
    axis = motion.axis
    if not motion.is_certain:
        advice.append(
            "the axis lies at the edge of the search range, and may be further off or steeper: "
            "turn or move the camera, then align again"
        )
    level, centred = abs(axis.tilt) <= MAX_TILT_RAD, abs(axis.offset) <= MAX_OFFSET_PX
    if settings.source == "simulated":
        if not centred:
            new_settings["simulated.off_axis"] = (
                round(settings.simulated.off_axis - axis.offset, 1) + 0.0
            )
        if not level:
            new_settings["simulated.tilt"] = round(settings.simulated.tilt - axis.tilt, 3) + 0.0
    else:
        if not level:
            way = "clockwise" if axis.tilt > 0.0 else "counter-clockwise"
            advice.append(
                f"turn the camera {way}, as seen from behind it, by "
                f"{abs(math.degrees(axis.tilt)):.1f}°"
            )
        if not centred:
            crop = _centred_crop(axis, motion.energy.shape[0], picture, settings.picture.crop)
            for name in ("y", "side"):
                value = round(getattr(crop, name), 3)
                if value != round(getattr(settings.picture.crop, name), 3):
                    new_settings[f"picture.crop.{name}"] = value
    good = level and centred and motion.is_certain and not edges
    return Alignment(motion, place, good, tuple(advice), new_settings)


def _centred_crop(axis: Axis, size: int, picture: tuple[int, int], crop: Square) -> Square:
    """Return the square whose middle row is the axis, smaller where the picture is too small."""
    height, shorter = picture[0], min(picture)
    side = crop.side * shorter
    half = 0.5 * side / height
    # Middle of the square, after it was moved inside the picture.
    middle = min(max(crop.y, half), 1.0 - half)
    middle += axis.offset * side / size / height
    room = 2.0 * min(middle, 1.0 - middle) * height
    return Square(x=crop.x, y=middle, side=max(0.05, min(side, room) / shorter))


def _needed_turn(motion: Motion) -> int:
    """Return the clockwise turn of the picture that puts the head at the left [degrees]."""
    energy = motion.energy
    upright = find_axis(np.ascontiguousarray(energy.T))
    likeness = compute_likeness(energy, motion.axis)
    if compute_likeness(energy.T, upright) > _UPRIGHT_LIKENESS_RATIO * likeness:
        return 270 if _tail_is_right(energy.T) else 90
    return 0 if _tail_is_right(energy) else 180


def _tail_is_right(energy: Floats) -> bool:
    """Return whether the motion grows towards the right, as if the tail's root is at the left."""
    strength = energy.sum(axis=0)
    moving = np.flatnonzero(strength > 0.05 * strength.max())
    middle = 0.5 * (moving[0] + moving[-1])
    centre = float(strength @ np.arange(len(strength)) / strength.sum())
    return centre >= float(middle)


def _place(energy: Floats) -> Place:
    return Place(*_middle_range(energy.sum(axis=1)), *_middle_range(energy.sum(axis=0)))


def _middle_range(strength: Floats) -> tuple[int, int]:
    """Return the first and last index of the middle nine tenths of `strength`."""
    share = np.cumsum(strength) / strength.sum()
    return int(np.searchsorted(share, 0.05)), int(np.searchsorted(share, 0.95))


def _edges_reached(energy: Floats) -> list[str]:
    """Return the edges of the picture that strong motion reaches."""
    limit = _EDGE_FRACTION * float(np.quantile(energy[energy > 0.0], 0.9))
    edges = {
        "the upper edge": energy[:2],
        "the lower edge": energy[-2:],
        "the left edge": energy[:, :2],
        "the right edge": energy[:, -2:],
    }
    return [name for name, edge in edges.items() if float(np.quantile(edge, 0.9)) > limit]
