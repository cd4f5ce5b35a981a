"""Pictures drawn with characters."""

import io
import re

import numpy as np
import pytest
from rich.console import Console

from fishd.camera.drawing import to_colours
from fishd.cli.camera.terminal import TerminalPicture


def draw_lines(picture: np.ndarray, width: int, height: int, system: str | None) -> list[str]:
    out = io.StringIO()
    console = Console(
        file=out, width=width, height=height, force_terminal=True,
        color_system=system, no_color=system is None, legacy_windows=False,
    )  # type: ignore[arg-type]  # fmt: skip
    console.print(TerminalPicture(to_colours(picture)))
    return out.getvalue().splitlines()


def plain(lines: list[str]) -> list[str]:
    return [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in lines]


@pytest.mark.parametrize("system", ["truecolor", "256", "standard", None])
@pytest.mark.parametrize(("width", "height"), [(40, 24), (200, 60), (84, 12), (5, 100), (1, 1)])
@pytest.mark.parametrize("shape", [(84, 84), (60, 160)])
def test_a_picture_fits_and_keeps_its_proportions(
    shape: tuple[int, int], width: int, height: int, system: str | None
) -> None:
    lines = plain(draw_lines(np.full(shape, 100, np.uint8), width, height, system))
    assert {len(line) for line in lines} == {len(lines[0])}
    columns, rows = len(lines[0]), 2 * len(lines)
    assert columns <= min(width, shape[1])
    assert len(lines) <= max(1, height - 4)
    if min(columns, rows) > 8:
        assert columns / rows == pytest.approx(shape[1] / shape[0], rel=0.2)


def test_each_character_shows_two_pixels_in_their_colours() -> None:
    picture = np.array([[0, 0, 240], [240, 0, 0]], np.uint8)
    (line,) = draw_lines(picture, 80, 24, "truecolor")
    black, white = "0;0;0", "240;240;240"
    assert line == (
        f"\x1b[38;2;{black};48;2;{white}m▀\x1b[0m"
        f"\x1b[38;2;{black};48;2;{black}m▀\x1b[0m"
        f"\x1b[38;2;{white};48;2;{black}m▀\x1b[0m"
    )


def test_without_colours_shades_of_grey_are_drawn() -> None:
    ramp = np.tile(np.arange(0, 250, 50, dtype=np.uint8), (2, 1))
    assert draw_lines(ramp, 80, 24, None) == ["  ░▒▓"]
