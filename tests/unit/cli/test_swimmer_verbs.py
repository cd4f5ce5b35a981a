"""fishctl swimmer: pictures of what fishctl simulate has left."""

from pathlib import Path

import pytest
from PIL import Image
from rigs.coarse_swimmer import OPTIONS
from rigs.processes import fishctl, one_line


@pytest.fixture(scope="module")
def swum(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the files of a swim of 0.8 s."""
    folder = tmp_path_factory.mktemp("swum")
    files = ["--checkpoint", "end.npz", "--save", "swim.npz", "--film", "wake.webp"]
    paths = [str(folder / word) if "." in word else word for word in files]
    lengths = ("--seconds", "0.8", "--settle", "0.2")
    done = fishctl("simulate", "square", "--frequency", "4", *lengths, *OPTIONS, *paths)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


@pytest.mark.slow
def test_a_film_is_painted_while_it_swims(swum: Path) -> None:
    with Image.open(swum / "wake.webp") as film:
        assert film.n_frames == 41  # the first and the last among them
        assert film.width == 600


@pytest.mark.slow
def test_the_wake_is_drawn_from_a_checkpoint(swum: Path, tmp_path: Path) -> None:
    words = ("swimmer", "wake", str(swum / "end.npz"), "--to", str(tmp_path))
    done = fishctl(*words)
    assert (done.returncode, done.stderr) == (0, "")
    names = ["end-vorticity.png", "end-speed.png"]
    assert done.stdout.split() == [str(tmp_path / name) for name in names]
    assert all((tmp_path / name).stat().st_size > 20_000 for name in names)
    assert "already exists; use --force to replace it" in one_line(fishctl(*words))
    assert fishctl(*words, "--force", "--field", "pressure", "--limit", "5").returncode == 0


@pytest.mark.slow
def test_midlines_are_drawn_from_a_saved_swim(swum: Path, tmp_path: Path) -> None:
    words = ("swimmer", "midlines", str(swum / "swim.npz"), "--to", str(tmp_path))
    done = fishctl(*words, "--settle", "0.2", "--form", "svg")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "swim-midlines.svg").stat().st_size > 10_000
    assert " Hz, tail ±0." in done.stdout
    assert "does not complete a beat" in one_line(fishctl(*words, "--settle", "0.65"))


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["wake", "swim.npz"], "it is not a checkpoint of a swimmer"),
        (["wake", "none.npz"], "no such file"),
        (["wake", "end.npz", "--limit", "5"], "--limit applies to one field"),
        (["midlines", "end.npz"], "it contains no midlines"),
        (["midlines", "wake.webp"], "not an NPZ file"),
    ],
)
def test_nothing_to_draw_is_told(swum: Path, tmp_path: Path, words: list[str], named: str) -> None:
    verb, file, *rest = words
    line = one_line(fishctl("swimmer", verb, str(swum / file), *rest, "--to", str(tmp_path)))
    assert named in line
    assert not list(tmp_path.iterdir())


def test_a_film_of_a_tethered_fish_or_of_another_kind_is_refused(tmp_path: Path) -> None:
    film = ("--film", str(tmp_path / "wake.mp4"))
    assert "--film is for robot: swimmer" in one_line(fishctl("simulate", "square", *film))
    line = one_line(fishctl("simulate", "square", *OPTIONS, *film))
    assert "a film has no format .mp4" in line
