"""Conversion of a camera's picture for learners."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fishd.camera import picture
from fishd.camera.settings import PictureSettings, PublishSettings, Square

shares = st.floats(0.0, 1.0)


@given(st.integers(16, 200), st.integers(16, 200), shares, shares, st.floats(0.05, 1.0))
def test_the_square_lies_in_the_picture_wherever_it_is_asked_for(
    width: int, height: int, x: float, y: float, side: float
) -> None:
    settings = PictureSettings(crop=Square(x=x, y=y, side=side))
    part, place = picture.crop(np.zeros((height, width), np.uint8), settings)
    assert part.shape[0] == part.shape[1] == max(1, round(side * min(width, height)))
    assert 0.0 <= place.left <= place.left + place.width <= 1.0 + 1e-9
    assert 0.0 <= place.top <= place.top + place.height <= 1.0 + 1e-9


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
def test_a_picture_is_turned_clockwise(rotate: int) -> None:
    whole = np.arange(12, dtype=np.uint8).reshape(3, 4)
    turned = picture.rotate(whole, rotate)
    assert np.array_equal(turned, np.rot90(whole, -rotate // 90))


def test_a_frame_is_the_mean_over_areas() -> None:
    whole = np.random.default_rng(0).integers(0, 256, (64, 64), dtype=np.uint8)
    frame = picture.make_frame(whole, PictureSettings(size=16))
    mean = whole.reshape(16, 4, 16, 4).mean(axis=(1, 3))
    assert np.abs(frame - mean).max() <= 0.51


def test_a_small_picture_has_larger_pixels_for_people() -> None:
    small, large = np.zeros((84, 84), np.uint8), np.zeros((480, 640), np.uint8)
    _, width, height = picture.encode_jpeg(small, PublishSettings(view_width=480))
    assert (width, height) == (420, 420)
    _, width, height = picture.encode_jpeg(large, PublishSettings(view_width=320))
    assert (width, height) == (320, 240)
