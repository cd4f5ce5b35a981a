"""Pictures of a free swimmer: positions in them, and films that show the swim."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fishd.core.errors import FishdError
from fishd.lab.swimmer import wake
from fishd.lab.swimmer.film import MAX_FRAMES, Film
from fishd.lab.swimmer.midlines import compute_envelope
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.settings import Numerics, SwimmerSettings

COARSE = SwimmerSettings(numerics=Numerics(cell=2e-3, step=1e-3))


@pytest.fixture(scope="module")
def fish() -> Fish:
    """Fish after a second of a square wave of 2.5 Hz."""
    swimmer = Fish(COARSE)
    for step in range(1000):
        swimmer.step(1.0 if step % 400 < 200 else -1.0)
    return swimmer


def test_a_view_shows_the_water_where_it_is_in_the_laboratory(fish: Fish) -> None:
    shown = wake.take_view(fish, wake.window_around(COARSE), 300)
    window = shown.window
    assert window.left == pytest.approx(-0.09 + fish.travelled[0])
    assert shown.x == fish.motion().x
    assert shown.outline[:, 0].min() < shown.x < shown.outline[:, 0].max()
    rows, columns = shown.vorticity.shape
    assert columns == 300
    assert (window.top - window.bottom) / rows == pytest.approx(0.3 / columns, rel=1e-2)
    row, column = np.unravel_index(np.abs(shown.vorticity).argmax(), shown.vorticity.shape)
    assert abs(window.left + 0.3 * (column + 0.5) / columns - shown.x) < 0.08  # not in the far wake
    assert abs(window.bottom + 0.3 * (row + 0.5) / columns) < 0.04


def test_between_the_nodes_of_a_stretched_grid_a_view_is_linear(
    fish: Fish, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = fish.flow.grid
    x, y = grid.x[1:-1], grid.y[1:-1]
    monkeypatch.setattr(fish.flow, "vorticity", lambda: 3.0 * x[:, None] + 2.0 * y[None])
    shown = wake.take_view(fish, wake.window_around(COARSE), 50)
    midpoints = shown.window.left - fish.travelled[0] + 0.3 * (np.arange(50) + 0.5) / 50
    assert shown.vorticity.mean(axis=0) == pytest.approx(3.0 * midpoints)


def test_the_colours_end_at_a_round_value_of_the_size_that_occurs(fish: Fish) -> None:
    limit = wake.choose_colour_limit(COARSE)
    shown = wake.take_view(fish, wake.window_around(COARSE), 300)
    assert f"{limit:.0e}"[0] in "1235"
    assert 0.1 * limit < np.abs(shown.vorticity).max() < 10.0 * limit


def test_a_picture_of_a_wake_is_made(fish: Fish, tmp_path: Path) -> None:
    shown = wake.take_view(fish, wake.window_around(COARSE), 200)
    wake.draw_wake(shown, wake.choose_colour_limit(COARSE), tmp_path / "wake.png")
    with Image.open(tmp_path / "wake.png") as picture:
        assert picture.width > 1.5 * picture.height  # as the window is


@pytest.mark.parametrize("kind", [".webp", ".gif"])
def test_a_film_has_a_frame_every_20_ms_and_the_fish_moves(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"wake{kind}"
    swimmer = Fish(COARSE)
    with Film(path, COARSE) as film:
        for _ in range(200):
            swimmer.step(1.0)
            film.add_frame(swimmer)
    with Image.open(path) as shown:
        assert shown.n_frames == 11  # the first and the last among them
        first, *_, last = [frame.astype(int) for frame in pixels(shown)]
    assert (np.abs(first - last).sum(axis=2) > 100).sum() > 200


def pixels(film: Image.Image) -> Iterator[np.ndarray]:
    for number in range(film.n_frames):
        film.seek(number)
        yield np.asarray(film.convert("RGB"))


def test_a_long_film_leaves_frames_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert MAX_FRAMES < 1000
    monkeypatch.setattr("fishd.lab.swimmer.film.MAX_FRAMES", 4)
    path = tmp_path / "wake.webp"
    swimmer = Fish(COARSE)
    with Film(path, COARSE) as film:
        for _ in range(320):
            swimmer.step(1.0)
            film.add_frame(swimmer)
    with Image.open(path) as shown:
        assert shown.n_frames == 3  # of 17
        list(pixels(shown))
        assert shown.info["duration"] == pytest.approx(320, rel=0.01)  # eight of 40 ms in one


@pytest.mark.parametrize("kind", [".webp", ".gif"])
def test_a_film_is_half_as_fast_as_the_fish_where_ticks_are_long(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"wake{kind}"
    swimmer = Fish(COARSE)
    with Film(path, COARSE) as film:
        for step in range(1, 201):
            swimmer.step(1.0)
            if step % 50 == 0:
                film.add_frame(swimmer)
    with Image.open(path) as shown:
        assert shown.n_frames == 4
        list(pixels(shown))
        assert shown.info["duration"] == 100  # of 50 ms


def make_midlines(beats: float, frequency: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Return midlines of a stiff body whose tail beats by ±0.1 L, obliquely to the axes."""
    time = np.arange(0.0, beats / frequency, 0.005)
    along = np.linspace(0.0, 0.1, 41)
    across = 0.01 * (along / 0.1) ** 2 * np.sin(2.0 * np.pi * frequency * time)[:, None]
    c, s = np.cos(0.2), np.sin(0.2)
    x, y = c * along - s * across, s * along + c * across
    return time, np.stack([x - 0.08 * time[:, None], y + 0.01 * time[:, None]], axis=2)


def test_midlines_are_relative_to_the_mean_motion_wherever_the_fish_goes() -> None:
    envelope = compute_envelope(*make_midlines(5.5))
    assert envelope.periods == pytest.approx([0.5] * 4, rel=1e-3)
    assert envelope.amplitudes[:, -1] == pytest.approx(0.1, rel=5e-3)
    assert envelope.amplitudes[:, 20] == pytest.approx(0.025, rel=5e-3)
    assert envelope.amplitudes[:, 0] == pytest.approx(0.0, abs=5e-4)
    assert envelope.midlines[:, 0, 0] == pytest.approx(0.0, abs=0.01)
    assert envelope.midlines[:, -1, 0] == pytest.approx(1.0, abs=0.02)


def test_a_tail_that_does_not_beat_has_no_midlines_of_a_beat() -> None:
    with pytest.raises(FishdError, match="does not complete a beat"):
        compute_envelope(*make_midlines(0.7))
