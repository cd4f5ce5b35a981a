"""Pictures of a camera's view, drawn for the operator."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fishd.camera import drawing
from fishd.camera.axis import Axis
from fishd.camera.messages import Crop, PublishedView, ViewHeader
from fishd.core.errors import FishdError

GREY = np.full((40, 60), 120, np.uint8)


def rows_of(colours: drawing.Colours, colour: tuple[int, int, int], column: int) -> list[int]:
    return np.flatnonzero((colours[:, column] == colour).all(axis=1)).tolist()


def test_the_axis_is_drawn_where_it_lies() -> None:
    drawn = drawing.draw_axis(drawing.to_colours(GREY[:40, :40]), Axis(offset=4.5, tilt=0.1), 40)
    assert rows_of(drawn, drawing.AXIS_COLOUR, 0) == [22]
    assert rows_of(drawn, drawing.AXIS_COLOUR, 20) == [24]
    assert rows_of(drawn, drawing.AXIS_COLOUR, 39) == [26]


def test_in_an_enlarged_picture_it_is_drawn_at_the_same_place() -> None:
    large = drawing.enlarge(drawing.to_colours(GREY[:40, :40]))
    drawn = drawing.draw_axis(large, Axis(offset=4.5), 40)
    assert 24 * 16 < np.mean(rows_of(drawn, drawing.AXIS_COLOUR, 320)) < 25 * 16


def test_in_a_whole_picture_what_frames_show_is_outlined() -> None:
    crop = Crop(left=0.25, top=0.25, width=0.5, height=0.5)
    drawn = drawing.draw_crop(drawing.to_colours(GREY), crop)
    assert rows_of(drawn, drawing.CROP_COLOUR, 30) == [10, 30]
    assert rows_of(drawn, drawing.CROP_COLOUR, 5) == []
    whole = Crop(left=0.0, top=0.0, width=1.0, height=1.0)
    assert rows_of(drawing.draw_crop(drawing.to_colours(GREY), whole), drawing.CROP_COLOUR, 0) == []


def test_a_file_shows_the_same_colours(tmp_path: Path) -> None:
    red = np.zeros((4, 4, 3), np.uint8)
    red[:, :, 0] = 255
    drawing.write_png(tmp_path / "red.png", drawing.enlarge(red))
    image = cv2.imread(str(tmp_path / "red.png"))
    assert image.shape == (640, 640, 3)
    assert (image == [0, 0, 255]).all()


def test_a_file_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(FishdError, match=r"a\.png cannot be written: No such file or directory"):
        drawing.write_png(tmp_path / "none" / "a.png", drawing.to_colours(GREY))


def test_a_view_that_is_no_picture_is_refused() -> None:
    crop = Crop(left=0.0, top=0.0, width=1.0, height=1.0)
    header = ViewHeader(session="a", seq=1, time=0.0, width=4, height=4, crop=crop)
    with pytest.raises(FishdError, match="not a JPEG"):
        drawing.decode_view(PublishedView(header, b"nonsense"))
