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
    files = ["--to", "swim.npz", "--film", "wake.webp"]
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
def test_the_wake_is_drawn_beside_its_swim(swum: Path) -> None:
    words = ("swimmer", "wake", str(swum / "swim.npz"))
    done = fishctl(*words)
    assert (done.returncode, done.stderr) == (0, "")
    picture = swum / "swim-vorticity.png"
    assert done.stdout == f"{picture}\n"
    assert picture.stat().st_size > 20_000
    words = (*words, "--plot", str(picture))
    assert "already exists; use --force to replace it" in one_line(fishctl(*words))
    assert fishctl(*words, "--force").returncode == 0


@pytest.mark.slow
def test_midlines_are_drawn_from_a_saved_swim(swum: Path, tmp_path: Path) -> None:
    words = ("swimmer", "midlines", str(swum / "swim.npz"), "--plot")
    done = fishctl(*words, str(tmp_path / "beat.svg"), "--settle", "0.2")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "beat.svg").stat().st_size > 10_000
    assert " Hz, tail ±0." in done.stdout
    late = (str(tmp_path / "late.svg"), "--settle", "0.65")
    assert "does not complete a beat" in one_line(fishctl(*words, *late))


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["wake", "wake.webp"], "it is not a swim of 'fishctl simulate --to'"),
        (["wake", "none.npz"], "no such file"),
        (["midlines", "wake.webp"], "it is not a swim of 'fishctl simulate --to'"),
    ],
)
def test_nothing_to_draw_is_told(
    swum: Path, tmp_path: Path, words: list[str], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    verb, file, *rest = words
    line = one_line(fishctl("swimmer", verb, str(swum / file), *rest))
    assert named in line
    assert not list(tmp_path.iterdir())


def test_a_film_of_a_tethered_fish_or_of_another_kind_is_refused(tmp_path: Path) -> None:
    film = ("--film", str(tmp_path / "wake.mp4"))
    assert "--film is for robot: swimmer" in one_line(fishctl("simulate", "square", *film))
    line = one_line(fishctl("simulate", "square", *OPTIONS, *film))
    assert "a film has no format .mp4" in line
