"""`fishctl camera measure VIDEO`: the fin angle of each picture of a video, in a table."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas
import pytest
from msgspec.structs import replace
from rigs.filmed_swim import swum
from rigs.filmed_tail import Film, FilmedTail, rest_before, sine
from rigs.filmed_video import film_video, write_video
from rigs.interrupted_table import interrupt_after
from rigs.processes import fishctl, one_line
from rigs.recordings import write
from scipy.interpolate import CubicSpline

from fishd.camera.tail.meter import TailMeter
from fishd.camera.video_table import CannotWriteTable, VideoTable
from fishd.core.signals import Tick
from fishd.core.tail_reading import TailReading

pytestmark = pytest.mark.slow
BEGIN, SECONDS = 1.25, 8.0
"""Time of the first tick in the video, and length of the video [s]."""
MM = 80.0


@pytest.fixture(scope="module")
def ticks() -> list[Tick]:
    return swum(12.0)


@pytest.fixture(scope="module")
def camera(ticks: list[Tick]) -> FilmedTail:
    """A camera above the fish of the ticks, which begins before them."""
    spline = CubicSpline([tick.time for tick in ticks], [tick.alpha for tick in ticks])
    return FilmedTail(Film(width=400, height=240, motion=rest_before(BEGIN, spline)))


@pytest.fixture(scope="module")
def video(camera: FilmedTail, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return film_video(tmp_path_factory.mktemp("video") / "fish.avi", camera, 0.0, SECONDS)


@pytest.fixture(scope="module")
def run(ticks: list[Tick], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("run") / "run", ticks)


Result = tuple[pandas.DataFrame, dict[str, Any], Path]


@pytest.fixture(scope="module")
def measured(video: Path, run: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The table, the printed result and the folder of a measurement with all options."""
    folder = tmp_path_factory.mktemp("measured")
    done = measure(
        video, folder / "fish.csv",
        *("--with", run, "--length", MM, "--plot", folder / "fish.png", "--json"),
        *("--learn", "--learned", folder / "fish.bin"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return pandas.read_csv(folder / "fish.csv"), json.loads(done.stdout), folder


def measure(video: Path, table: Path, *more: object) -> subprocess.CompletedProcess[str]:
    return fishctl("camera", "measure", str(video), "--to", str(table), *map(str, more))


def test_a_table_has_the_fin_angle_of_each_picture(measured: Result, camera: FilmedTail) -> None:
    table, result, _ = measured
    error = table.fin_angle - camera.alpha(table.video_time.to_numpy())
    assert len(table) == result["pictures"] == 30 * SECONDS
    assert table.fin_angle.count() == result["known"] > 0.95 * len(table)
    assert table.reason.count() == sum(result["unknown"].values()) == len(table) - result["known"]
    assert error.std() < 3e-3
    assert error.abs().max() < 0.02
    assert (error - error.mean()).abs().quantile(0.95) < table.fin_angle_uncertainty.median()
    assert table.video_time.diff().dropna().to_numpy() == pytest.approx(1 / 30, abs=1e-5)


def test_the_tip_is_in_millimetres_for_a_known_length(measured: Result) -> None:
    table = measured[0]
    assert table.tip_along_mm[0] == pytest.approx(MM, rel=0.02)
    assert table.tip_across_mm.max() > 0.1 * MM


def test_the_clock_of_a_recording_of_the_same_swim_is_found(measured: Result) -> None:
    table, result, _ = measured
    assert result["video_begin"] == pytest.approx(-BEGIN, abs=5e-3)
    assert 0.0 < result["video_begin_ci95"] < 0.01
    assert (table.elapsed - table.video_time).to_numpy() == pytest.approx(-BEGIN, abs=5e-3)


def test_the_figure_has_the_midline_in_the_picture(measured: Result) -> None:
    picture = cv2.imread(str(measured[2] / "fish.png"))
    assert picture is not None
    green = (picture[..., 1] > picture[..., 2] + 80) & (picture[..., 1] > picture[..., 0])
    assert np.count_nonzero(green) > 200


def test_an_interrupted_measurement_leaves_the_tail_that_it_has_learned(
    video: Path, measured: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned, target = tmp_path / "fish.bin", tmp_path / "fish.csv"
    with interrupt_after(0, monkeypatch):
        measure(video, target, "--learn", "--learned", learned)
    for words in (("--learned", learned), ("--learn", "--learned", learned)):
        with interrupt_after(9, monkeypatch):
            assert "9 pictures are measured" in measure(video, target, *words).stderr
        (tmp_path / "fish.csv.part").unlink()
    assert measure(video, target, "--learned", learned).returncode == 0
    assert pandas.read_csv(target).fin_angle.equals(measured[0].fin_angle)


def test_an_interrupted_measurement_goes_on_where_it_ended(
    video: Path, measured: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "fish.csv"
    with interrupt_after(170, monkeypatch):
        done = measure(video, target)
    assert done.returncode == 130
    assert "170 pictures are measured; the same command goes on" in done.stderr
    assert not target.exists()
    with (tmp_path / "fish.csv.part").open("a") as part:
        part.write("5.6666,0.1")  # a row that a kill has torn
    measured_again: list[float] = []
    add = VideoTable.add
    monkeypatch.setattr(
        VideoTable, "add", lambda *row: measured_again.append(float(row[1][0])) or add(*row)
    )
    assert measure(video, target).returncode == 0
    assert measured_again[0] == pytest.approx(170 / 30, abs=1e-3)
    resumed, whole = pandas.read_csv(target), measured[0]
    assert resumed.fin_angle.equals(whole.fin_angle)
    assert list(tmp_path.iterdir()) == [target]


def test_the_midline_is_added_on_request(video: Path, measured: Result, tmp_path: Path) -> None:
    learned = "--learned", measured[2] / "fish.bin"
    assert measure(video, tmp_path / "fish.csv", "--midline", *learned).returncode == 0
    table = pandas.read_csv(tmp_path / "fish.csv")
    ends = table[["x15_px", "y15_px"]].to_numpy()
    assert ends == pytest.approx(table[["tip_column", "tip_row"]].to_numpy(), abs=0.01)
    x = table[[f"x{k}_px" for k in range(16)]].to_numpy()
    assert (np.diff(x, axis=1) > 0.0).all()
    assert table.y0_px.std() < 1.0 < table.y15_px.std()


def test_the_rows_of_a_rolling_shutter_have_their_own_times(tmp_path: Path) -> None:
    film = Film(width=400, height=240, motion=rest_before(0.5, sine(0.2)), read_out=0.03)
    camera = FilmedTail(film)
    video = film_video(tmp_path / "fish.avi", camera, 0.0, 4.0)
    done = measure(video, tmp_path / "fish.csv", "--read-out", "30")
    assert done.returncode == 0, done.stderr
    table = pandas.read_csv(tmp_path / "fish.csv")
    late = table.video_time - np.arange(len(table)) / 30
    assert np.ptp(late) > 2e-3
    error = table.fin_angle - camera.alpha(table.video_time.to_numpy())
    assert error.std() < 4e-3


def test_unknown_beats_do_not_lower_the_frequency(
    video: Path, measured: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, frequency = TailMeter.read, measured[1]["frequency"]

    def read_half(meter: TailMeter, time: float, *rest: Any) -> TailReading:
        reading = read(meter, time, *rest)
        return reading if time * frequency % 2.0 < 1.4 else replace(reading, alpha=None)

    monkeypatch.setattr(TailMeter, "read", read_half)
    learned = "--learned", measured[2] / "fish.bin"
    result = json.loads(measure(video, tmp_path / "fish.csv", "--json", *learned).stdout)
    assert 2 <= result["beats"] < 0.7 * measured[1]["beats"]
    assert result["frequency"] in (None, pytest.approx(frequency, rel=0.1))


def test_the_rate_of_the_command_line_replaces_that_of_the_file(
    video: Path, measured: Result, tmp_path: Path
) -> None:
    learned = measured[2] / "fish.bin"
    done = measure(video, tmp_path / "slow.csv", "--rate", "15", "--learned", learned, "--json")
    table = pandas.read_csv(tmp_path / "slow.csv")
    assert table.video_time.iloc[-1] == pytest.approx((30 * SECONDS - 1) / 15)
    assert json.loads(done.stdout)["fin_angle_max"] > 0.05


def test_a_video_with_the_head_at_the_right_is_turned(tmp_path: Path) -> None:
    film = FilmedTail(Film(width=320, height=240, motion=rest_before(0.5, sine(0.2))))
    pictures = [cv2.rotate(shot.picture, cv2.ROTATE_180) for shot in film.shots(0.0, 2.7)]
    video = write_video(tmp_path / "turned.avi", pictures, 30.0)
    assert "turn the picture so that the head is at the left" in one_line(
        measure(video, tmp_path / "a.csv")
    )
    done = measure(video, tmp_path / "b.csv", "--rotate", "180", "--json")
    assert json.loads(done.stdout)["fin_angle_max"] == pytest.approx(0.2, rel=0.01)


def test_the_tail_is_learned_from_pictures_of_a_fast_camera(video: Path, tmp_path: Path) -> None:
    done = measure(video, tmp_path / "fish.csv", "--rate", "5000")
    assert done.returncode == 0
    assert "the tail is learned from 0 s of the video on" in done.stderr


Make = Callable[[Path], Path]


def still(path: Path) -> Path:
    film = FilmedTail(Film(width=320, height=240, motion=sine(0.0)))
    return film_video(path / "still.avi", film, 0.0, 3.0)


def short(path: Path) -> Path:
    return film_video(path / "short.avi", FilmedTail(Film(width=320, height=240)), 1.0, 2.0)


def raw(path: Path) -> Path:
    jpeg = cv2.imencode(".jpg", np.zeros((64, 64), np.uint8))[1].tobytes()
    (path / "raw.mjpeg").write_bytes(20 * jpeg)
    return path / "raw.mjpeg"


def content(text: str) -> Make:
    def make(path: Path) -> Path:
        (path / "video.mp4").write_text(text)
        return path / "video.mp4"

    return make


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (content(""), "video.mp4 is empty: give a video file"),
        (content("no video"), "is not a video, or has a codec that OpenCV cannot read: convert it"),
        (lambda path: path / "none.mp4", "none.mp4 cannot be read: No such file or directory"),
        (lambda path: path, " is a folder: give a video file"),
        (raw, "does not state when its pictures were taken: give their rate, such as --rate 30"),
        (still, "nothing swings: let the fish swim"),
        (short, "30 pictures are too few to learn from; 60 are needed"),
    ],
    ids=["empty", "no video", "no file", "a folder", "no rate", "at rest", "short"],
)
def test_what_cannot_be_measured_is_named_and_leaves_no_file(
    tmp_path: Path, make: Make, message: str
) -> None:
    folder = tmp_path / "result"
    folder.mkdir()
    done = measure(make(tmp_path), folder / "fish.csv")
    assert done.returncode == 1
    assert message in one_line(done)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("nowhere/fish.csv", "its folder does not exist; create it"),
        ("file/fish.csv", "cannot be written: Not a directory"),
        ("file", "exists already: give another file with --to"),
    ],
)
def test_a_table_that_cannot_be_written_is_refused_before_anything_is_measured(
    video: Path, tmp_path: Path, table: str, message: str
) -> None:
    (tmp_path / "file").write_text("kept")
    assert message in one_line(measure(video, tmp_path / table))
    assert (tmp_path / "file").read_text() == "kept"


def test_a_read_out_longer_than_a_picture_is_refused(video: Path, tmp_path: Path) -> None:
    done = measure(video, tmp_path / "fish.csv", "--read-out", "40")
    assert "--read-out must not exceed 33.33 ms, the time from one picture" in one_line(done)


def test_an_unfinished_table_of_something_else_is_kept(video: Path, tmp_path: Path) -> None:
    part = tmp_path / "fish.csv.part"
    part.write_text("kept\n")
    assert "is not an unfinished table: remove it" in one_line(
        measure(video, tmp_path / "fish.csv")
    )
    assert part.read_text() == "kept\n"


def test_rows_from_other_options_are_not_mixed(
    video: Path, measured: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned = "--learned", measured[2] / "fish.bin"

    def full(*_: Any) -> None:
        raise CannotWriteTable("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(VideoTable, "add", full)
        assert "the disk is full" in measure(video, tmp_path / "fish.csv", *learned).stderr
    done = measure(video, tmp_path / "fish.csv", "--rate", "20", *learned)
    assert "is from another video or other options: remove it" in one_line(done)


def test_a_figure_that_cannot_be_written_costs_no_measurement(
    video: Path, measured: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, learned = tmp_path / "fish.csv", ("--learned", measured[2] / "fish.bin")
    done = measure(video, target, "--plot", "/proc/fish.png", *learned)
    assert "/proc/fish.png: the figure cannot be written" in one_line(done)
    monkeypatch.setattr(VideoTable, "add", None)
    assert measure(video, target, *learned).returncode == 0
    assert pandas.read_csv(target).fin_angle.equals(measured[0].fin_angle)


def test_a_recording_of_another_swim_costs_no_measurement(
    video: Path, measured: Result, tmp_path: Path
) -> None:
    other = write(tmp_path / "other", swum(20.0, controller="swing"))
    target, learned = tmp_path / "fish.csv", ("--learned", measured[2] / "fish.bin")
    done = measure(video, target, "--with", other, *learned)
    assert "is the recording of this swim" in done.stderr
    assert "without --with, the same command writes the table" in done.stderr
    assert measure(video, target, *learned).returncode == 0
    assert pandas.read_csv(target).fin_angle.equals(measured[0].fin_angle)


def test_a_video_with_a_broken_end_is_measured_up_to_there(
    video: Path, measured: Result, tmp_path: Path
) -> None:
    broken, content = tmp_path / "broken.avi", video.read_bytes()
    broken.write_bytes(content[: len(content) // 2])
    done = measure(broken, tmp_path / "a.csv", "--learned", measured[2] / "fish.bin")
    assert done.returncode == 0
    rows = len(pandas.read_csv(tmp_path / "a.csv"))
    assert f"ends after {rows} of {len(measured[0])} pictures: it is damaged" in done.stderr


def test_a_video_of_another_size_than_the_learned_one_is_refused(
    measured: Result, tmp_path: Path
) -> None:
    camera = FilmedTail(Film(width=200, height=150))
    video = film_video(tmp_path / "small.avi", camera, 0.0, 0.2)
    done = measure(video, tmp_path / "a.csv", "--learned", measured[2] / "fish.bin")
    assert "has 200 × 150 pixels, but the tail was learned from 400 × 240" in one_line(done)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fish.avi",), "--to FILE.csv is needed for the table of a VIDEO"),
        (("fish.avi", "--to", "a.csv", "--learn"), "--learn needs --learned FILE"),
        (("fish.avi", "--to", "a.csv", "--for", "9"), "--for is for a camera, not for a VIDEO"),
        (("--rate", "30"), "--rate is for a VIDEO"),
        (("--midline",), "--midline is for a VIDEO"),
    ],
)
def test_options_for_something_else_are_refused(words: tuple[str, ...], message: str) -> None:
    done = fishctl("camera", "measure", *words)
    assert done.returncode == 2
    assert message in one_line(done)
