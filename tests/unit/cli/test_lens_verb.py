"""`fishctl camera lens` with files: a calibration from pictures and videos of a board."""

import json
from pathlib import Path

import cv2
import pandas
import pytest
from rigs.filmed_board import SQUARE_MM, FilmedBoard
from rigs.filmed_tail import Film, FilmedTail, rest_before, sine
from rigs.filmed_video import film_video, write_video
from rigs.processes import fishctl, one_line

from fishd.camera.tail.lens import Lens

pytestmark = pytest.mark.slow
FILM = Film(
    width=480, height=360, lens=-0.12, tilt=0.1, root=(0.08, 0.0),
    motion=rest_before(0.5, sine(0.3)),
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with pictures of a board, a calibration from them, and a video of a fish."""
    folder, board = tmp_path_factory.mktemp("lens"), FilmedBoard(FILM)
    for number, picture in enumerate(board.held()):
        cv2.imwrite(str(folder / f"held-{number}.png"), picture)
    cv2.imwrite(str(folder / "lying.png"), board.lying())
    cv2.imwrite(str(folder / "nothing.png"), 0 * picture)
    done = calibrate(folder, "lens.json", *sorted(folder.glob("held-*.png")))
    assert done.returncode == 0, done.stderr
    assert "the same command with --plane" in done.stdout
    (folder / "without-plane.json").write_bytes((folder / "lens.json").read_bytes())
    done = calibrate(folder, "lens.json", "lying.png", "--plane", "--square", SQUARE_MM, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["pixels_per_mm"] > 0.0
    film_video(folder / "fish.avi", FilmedTail(FILM), 0.0, 4.0)
    return folder


def calibrate(folder: Path, target: str, *words: object):  # type: ignore[no-untyped-def]
    """Run the verb; words that end in .png are files of the folder."""
    named = (str(folder / str(word) if str(word).endswith(".png") else word) for word in words)
    return fishctl("camera", "lens", *named, "--to", str(folder / target))


def test_a_video_is_measured_in_the_plane_of_the_tail(folder: Path) -> None:
    maxima = []
    for words in ((), ("--lens", str(folder / "lens.json"))):
        table = folder / f"{len(words)}.csv"
        done = fishctl(
            "camera", "measure", str(folder / "fish.avi"), "--to", str(table), *words, "--json"
        )
        assert done.returncode == 0, done.stderr
        maxima.append(json.loads(done.stdout)["fin_angle_max"])
    assert maxima[0] != pytest.approx(0.3, rel=0.01)
    assert maxima[1] == pytest.approx(0.3, rel=0.01)
    assert pandas.read_csv(table).tip_along_mm.median() == pytest.approx(
        FILM.length / 0.08 * SQUARE_MM, rel=0.15
    )


def test_a_tail_that_was_learned_without_the_lens_is_refused(folder: Path) -> None:
    fish, learned = str(folder / "fish.avi"), str(folder / "tail.bin")
    table = str(folder / "learned.csv")
    with_lens = ("--lens", str(folder / "lens.json"))
    words = ("camera", "measure", fish, "--learned", learned, "--to")
    assert fishctl(*words, table, "--learn").returncode == 0
    refused = one_line(fishctl(*words, str(folder / "b.csv"), *with_lens))
    assert "the tail was learned without this calibration of the lens, or with another" in refused
    assert fishctl(*words, str(folder / "c.csv"), "--learn", *with_lens).returncode == 0
    # The tail contains the lens; turned pictures are refused.
    assert fishctl(*words, str(folder / "d.csv")).returncode == 0
    turned = one_line(fishctl(*words, str(folder / "e.csv"), "--rotate", "180"))
    assert "calibrated with pictures turned by 0°: calibrate it again" in turned


def test_a_video_of_a_board_counts_where_the_board_is_still(folder: Path) -> None:
    held = [cv2.imread(str(folder / f"held-{number}.png"), 0) for number in range(15)]
    write_video(folder / "board.avi", [each for each in held for _ in range(3)], 10.0)
    done = calibrate(folder, "video.json", folder / "board.avi", "nothing.png")
    assert done.returncode == 0
    assert "nothing.png: 0 of 40 corners of the board are seen" in done.stderr
    focal = Lens.load(folder / "lens.json").focal
    assert Lens.load(folder / "video.json").focal == pytest.approx(focal, rel=5e-3)


def test_a_board_is_written_to_print(tmp_path: Path) -> None:
    done = fishctl("camera", "lens", "--board", str(tmp_path / "board.svg"), "--square", "40")
    assert done.stdout.endswith("board.svg: print it at 100 %; 9 squares are 360 mm\n")
    again = fishctl("camera", "lens", "--board", str(tmp_path / "board.svg"))
    assert "board.svg cannot be written: File exists" in one_line(again)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("held-1.png",), "view 1 of at least 10 is taken: show the board at the "),
        (("none.png",), "none.png cannot be read: No such file or directory"),
        (("nothing.png", "--plane"), "nothing.json: no such file"),
    ],
)
def test_what_cannot_be_calibrated_is_named(
    folder: Path, words: tuple[str, ...], message: str
) -> None:
    assert message in one_line(calibrate(folder, "nothing.json", *words))
    assert not (folder / "nothing.json").exists()


def test_a_file_that_cannot_be_written_is_refused_before_a_picture_is_read(folder: Path) -> None:
    done = calibrate(folder, "nowhere/lens.json", "none.png")
    assert "nowhere/lens.json: its folder does not exist; create it" in one_line(done)


def test_a_calibration_is_not_overwritten_by_another(folder: Path) -> None:
    before = (folder / "lens.json").read_bytes()
    assert "lens.json exists already: give another file with --to" in one_line(
        calibrate(folder, "lens.json", "held-1.png")
    )
    done = calibrate(folder, "lens.json", "nothing.png", "--plane")
    assert "nothing.png: 0 of 40 corners of the board are seen" in done.stderr
    assert (folder / "lens.json").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("a.png",), "--to FILE is needed with FILEs, and only with them"),
        (("--to", "a"), "--to FILE is needed with FILEs, and only with them"),
        (("--square", "20"), "--square is for --board and --plane"),
        (("a.png", "--to", "a", "--camera", "b"), "--camera is not for FILEs"),
        (("--board", "a.png"), "'a.png' is not valid for --board: a name ending in .svg is needed"),
    ],
)
def test_options_for_something_else_are_refused(words: tuple[str, ...], message: str) -> None:
    done = fishctl("camera", "lens", *words)
    assert done.returncode == 2
    assert message in one_line(done)
