"""Check of the alignment of a camera above the fish."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from rigs.filmed_swim import filmed, swum
from rigs.pictures import WEB

from fishd.camera.alignment import Alignment, judge
from fishd.camera.axis import find_motion
from fishd.camera.settings import CameraSettings, PictureSettings, Square
from fishd.core.camera_frames import Pixels

V4L2 = CameraSettings(source="v4l2")
VGA = (480, 640)


@cache
def pictures(**optics: float) -> Pixels:
    camera = replace(WEB, **({"off_axis": 0.0, "tilt": 0.0} | optics))
    frames = filmed(swum(10.0, controller="swing"), camera)
    return np.stack([frame.pixels for frame in frames])


def judge_pictures(seen: Pixels, settings: CameraSettings = V4L2, picture: Any = VGA) -> Alignment:
    return judge(find_motion(seen), picture, settings)


def turned(quarters: int) -> Pixels:
    """Return pictures turned clockwise by a number of quarter turns."""
    return np.ascontiguousarray(np.rot90(pictures(), -quarters, axes=(1, 2)))


def test_a_camera_that_stands_well_is_left_alone() -> None:
    alignment = judge_pictures(pictures())
    assert (alignment.is_aligned, alignment.advice, alignment.settings) == (True, (), {})
    assert 20 < alignment.place.left < alignment.place.right < 75
    assert alignment.place.top < 42 < alignment.place.bottom


@pytest.mark.parametrize(("tilt", "way"), [(0.1, "clockwise"), (-0.05, "counter-clockwise")])
def test_a_tilted_camera_is_turned_by_its_tilt(tilt: float, way: str) -> None:
    alignment = judge_pictures(pictures(tilt=tilt))
    assert not alignment.is_aligned
    assert f"turn the camera {way}, as seen from behind it, by " in alignment.advice[0]
    degrees = float(alignment.advice[0].split()[-1].rstrip("°"))
    assert degrees == pytest.approx(abs(math.degrees(tilt)), abs=0.6)


@pytest.mark.parametrize("side", [0.6, 1.0])
@pytest.mark.parametrize("off", [3.0, -6.0])
def test_the_crop_is_moved_so_that_the_axis_lies_in_its_middle(off: float, side: float) -> None:
    settings = replace(V4L2, picture=PictureSettings(crop=Square(side=side)))
    alignment = judge_pictures(pictures(off_axis=off), settings)
    y = alignment.settings["picture.crop.y"]
    new_side = alignment.settings.get("picture.crop.side", side)
    assert isinstance(y, float)
    assert isinstance(new_side, float)
    assert y == pytest.approx(0.5 + off / 84 * side, abs=0.01)
    assert y + new_side / 2 <= 1.001
    assert y - new_side / 2 >= -0.001
    assert new_side == side if side < 0.8 else new_side < side


@pytest.mark.parametrize("quarters", [1, 2, 3])
@pytest.mark.parametrize("rotate", [0, 90])
def test_a_fish_that_lies_otherwise_is_turned_head_left(quarters: int, rotate: Any) -> None:
    settings = replace(V4L2, picture=PictureSettings(rotate=rotate))
    alignment = judge_pictures(turned(quarters), settings)
    assert alignment.settings == {"picture.rotate": (rotate + 360 - 90 * quarters) % 360}
    assert not alignment.is_aligned
    assert "head to the left: turn it" in alignment.advice[-1]


def test_a_tail_that_leaves_the_picture_is_said_to() -> None:
    alignment = judge_pictures(pictures()[:, 33:51, :56])
    assert not alignment.is_aligned
    cut_off = "the motion is cut off at the upper edge and the lower edge and the right"
    assert alignment.advice[0].startswith(cut_off)


def test_an_axis_at_the_edge_of_what_is_looked_at_is_said_to_be_unsure() -> None:
    motion = find_motion(pictures())
    alignment = judge(motion._replace(is_certain=False), VGA, V4L2)
    assert not alignment.is_aligned
    assert "may be further off or steeper" in alignment.advice[0]


def test_of_a_simulated_camera_its_own_settings_are_named() -> None:
    simulated = replace(CameraSettings().simulated, off_axis=3.0, tilt=0.05)
    settings = CameraSettings(simulated=simulated)
    alignment = judge_pictures(pictures(off_axis=3.0, tilt=0.05), settings, (84, 84))
    assert alignment.settings["simulated.off_axis"] == pytest.approx(0.0, abs=0.3)
    assert alignment.settings["simulated.tilt"] == pytest.approx(0.0, abs=0.015)
