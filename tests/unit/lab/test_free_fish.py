"""Place, heading, speed, tail beat and Strouhal number of a fish that swims by itself."""

import json
from pathlib import Path

import cv2
import numpy as np
import pandas
import pytest
from rigs.filmed_video import FilmedFish, write_video
from rigs.interrupted_table import interrupt_after
from rigs.processes import fishctl, one_line

from fishd.camera.video_table import VideoTable

pytestmark = pytest.mark.slow
SECONDS, RATE, MM = 4.0, 25.0, 120.0


HELD = FilmedFish(speed=0.0, turn=0.0, begin=(200.0, 120.0))


def film(path: Path, fish: FilmedFish, seconds: float = SECONDS) -> Path:
    return write_video(path / "fish.avi", fish.pictures(seconds, RATE), RATE)


@pytest.mark.parametrize(
    ("fish", "length", "scale"),
    [
        (FilmedFish(), None, 1.0),
        (FilmedFish(speed=22.0, turn=-0.1, water=60.0, body=180.0), MM, MM / 60.0),
        (FilmedFish(tag=7), 20.0, 1.0),
        (FilmedFish(speed=-22.0, begin=(300.0, 140.0)), None, 1.0),
    ],
    ids=["dark", "light and slow", "tag", "the flow takes it along, tail first"],
)
def test_its_motion_is_measured(
    tmp_path: Path, fish: FilmedFish, length: float | None, scale: float
) -> None:
    words = ["--length", str(length)] if length else []
    words += ["--tag", str(fish.tag)] if fish.tag is not None else []
    target = tmp_path / "fish.csv"
    done = fishctl(
        "camera", "measure", str(film(tmp_path, fish)), "--free", "--to", str(target), "--json",
        *words,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result, table = json.loads(done.stdout), pandas.read_csv(target)
    unit = "mm" if length else "px"
    assert result["mean_speed"] == pytest.approx(scale * fish.speed, rel=0.02)
    assert result["frequency"] == pytest.approx(fish.frequency, rel=0.01)
    if fish.tag is None:  # the centre follows the tail a little
        assert 1.5 * fish.swing < result["excursion"] / scale < 2.0 * fish.swing
    else:
        assert result["excursion"] == pytest.approx(2.0 * fish.swing, rel=0.03)
    product = result["frequency"] * result["excursion"] / result["mean_speed"]
    assert result["strouhal"] == (pytest.approx(product) if fish.speed > 0.0 else None)
    assert result["length"] == pytest.approx(scale * fish.length, rel=0.05)
    truth = scale * np.array([fish.place(time) for time in table.video_time])
    place = table[[f"x_{unit}", f"y_{unit}"]].to_numpy()
    assert np.nanstd(place - truth, axis=0).max() < 1.2 * scale
    known = table.heading.notna()
    assert known.sum() > 20
    heading = [fish.heading(time) for time in table.video_time[known]]
    assert table.heading[known].to_numpy() == pytest.approx(heading, abs=0.02)
    assert table[f"speed_{unit}"][known].mean() == pytest.approx(scale * abs(fish.speed), rel=0.02)


@pytest.mark.parametrize(
    ("fish", "words", "message"),
    [
        (FilmedFish(speed=0.0, swing=0.0, turn=0.0), (), "nothing moves against a plain ground"),
        (FilmedFish(speed=500.0), (), "pictures: no fish is seen"),
        (FilmedFish(), ("--tag", "3"), "its tag is not seen"),
        (FilmedFish(), ("--learned", "a.bin"), "--learned is for a fish whose tail is measured"),
    ],
    ids=["at rest", "away", "no tag", "an option for a tail"],
)
def test_what_is_not_seen_is_named_and_leaves_no_table(
    tmp_path: Path, fish: FilmedFish, words: tuple[str, ...], message: str
) -> None:
    video = film(tmp_path, fish, 2.0)
    target = tmp_path / "fish.csv"
    done = fishctl("camera", "measure", str(video), "--free", "--to", str(target), *words)
    assert message in one_line(done)
    assert list(tmp_path.iterdir()) == [video]


@pytest.mark.parametrize("seconds", [SECONDS, 0.85], ids=["whole video", "two beats"])
def test_the_beat_of_a_fish_that_keeps_its_place_is_measured(
    tmp_path: Path, seconds: float
) -> None:
    video = write_video(tmp_path / "fish.avi", HELD.pictures(seconds, 100.0), 100.0)
    target = tmp_path / "fish.csv"
    done = fishctl("camera", "measure", str(video), "--free", "--to", str(target), "--json")
    result = json.loads(done.stdout)
    assert result["known"] == result["pictures"] == round(100 * seconds)
    assert result["frequency"] == pytest.approx(HELD.frequency, rel=0.05)
    assert result["excursion"] == pytest.approx(1.8 * HELD.swing, rel=0.1)
    assert result["length"] == pytest.approx(HELD.length, rel=0.05)
    assert result["strouhal"] is None
    assert (result["frequency_ci95"] is None) == (seconds < 1.0)  # one beat has no interval


@pytest.mark.parametrize(
    ("fish", "seconds", "problem"),
    [
        (FilmedFish(frequency=0.8), 1.2, "fewer than two whole beats are seen"),
        (FilmedFish(swing=0.0), SECONDS, "it is lost in the noise, or between the pictures"),
        (FilmedFish(frequency=7.0), SECONDS, "it is lost in the noise, or between the pictures"),
    ],
    ids=["short", "glides", "fast"],
)
def test_the_way_of_a_fish_without_a_beat_is_measured(
    tmp_path: Path, fish: FilmedFish, seconds: float, problem: str
) -> None:
    target = tmp_path / "fish.csv"
    words = ("camera", "measure", str(film(tmp_path, fish, seconds)), "--free", "--to", str(target))
    done = fishctl(*words)
    assert done.returncode == 0
    assert f"tail beat   unknown: {problem}" in done.stdout
    assert "Strouhal" not in done.stdout
    table = pandas.read_csv(target)
    places = np.array([fish.place(time) for time in table.video_time])
    error = table[["x_px", "y_px"]].to_numpy() - places
    assert np.nanstd(error, axis=0).max() < 1.2
    target.unlink()
    result = json.loads(fishctl(*words, "--json").stdout)
    assert problem in result["problem"]
    assert result["frequency"] is result["mean_speed"] is result["strouhal_ci95"] is None


def test_a_fish_that_is_small_in_a_large_picture_is_measured(tmp_path: Path) -> None:
    fish = FilmedFish(width=1500, height=300, length=90.0, swing=12.0, begin=(300.0, 90.0))
    target = tmp_path / "fish.csv"
    video = film(tmp_path, fish, 2.4)
    done = fishctl("camera", "measure", str(video), "--free", "--to", str(target), "--json")
    result, table = json.loads(done.stdout), pandas.read_csv(target)
    assert result["known"] == 60
    assert result["length"] == pytest.approx(fish.length, rel=0.02)
    assert result["frequency"] == pytest.approx(fish.frequency, rel=0.02)
    assert 1.5 * fish.swing < result["excursion"] < 2.0 * fish.swing
    truth = np.array([fish.place(time) for time in table.video_time])
    assert np.abs(table[["x_px", "y_px"]] - truth).std().max() < 1.8


def test_an_interrupted_search_goes_on_where_it_ended_with_the_same_ground(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = film(tmp_path, FilmedFish())
    words = ("camera", "measure", str(video), "--free", "--midline", "--to")
    whole, target = tmp_path / "whole.csv", tmp_path / "fish.csv"
    assert fishctl(*words, str(whole)).returncode == 0
    with interrupt_after(60, monkeypatch):
        done = fishctl(*words, str(target))
    assert done.returncode == 130
    assert "60 pictures are measured; the same command goes on" in done.stderr
    assert not target.exists()
    monkeypatch.setattr("fishd.lab.free_fish.learn_ground", None)
    assert fishctl(*words, str(target)).returncode == 0
    assert target.read_text() == whole.read_text()


def test_a_figure_that_cannot_be_written_costs_no_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "fish.csv"
    video = film(tmp_path, FilmedFish(), 2.0)
    words = ("camera", "measure", str(video), "--free", "--to", str(target))
    done = fishctl(*words, "--plot", "/proc/fish.png")
    assert "/proc/fish.png: the figure cannot be written" in one_line(done)
    monkeypatch.setattr(VideoTable, "add", None)
    assert fishctl(*words).returncode == 0
    assert len(pandas.read_csv(target)) == 50


def test_a_head_that_a_kill_has_torn_is_written_again(tmp_path: Path) -> None:
    video, target = film(tmp_path, FilmedFish(), 2.0), tmp_path / "fish.csv"
    (tmp_path / "fish.csv.part").write_text('{"source":{"video":"/home')
    done = fishctl("camera", "measure", str(video), "--free", "--to", str(target))
    assert done.returncode == 0, done.stderr
    assert len(pandas.read_csv(target)) == 50


def test_the_midline_leads_from_the_head_to_the_tail(tmp_path: Path) -> None:
    fish = FilmedFish(turn=-0.5)
    target, picture = tmp_path / "fish.csv", tmp_path / "fish.png"
    done = fishctl(
        "camera", "measure", str(film(tmp_path, fish)), "--free", "--midline", "--plot",
        str(picture), "--to", str(target),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    table = pandas.read_csv(target)
    x, y = (table[[f"{axis}{k}_px" for k in range(16)]].to_numpy() for axis in "xy")
    heading = np.array([fish.heading(time) for time in table.video_time])[:, None]
    x, y = x - table[["x_px"]].to_numpy(), y - table[["y_px"]].to_numpy()
    along = (x * np.cos(heading) + y * np.sin(heading))[table.x_px.notna()]
    assert len(along) > 60
    assert (np.diff(along, axis=1) < 0.0).all()
    assert np.ptp(along, axis=1) == pytest.approx(fish.length, rel=0.1)
    shown = cv2.imread(str(picture))
    assert shown is not None
    green = (shown[..., 1] > shown[..., 2] + 80) & (shown[..., 1] > shown[..., 0])
    assert np.count_nonzero(green) > 200


def test_a_rolling_shutter_shows_the_fish_at_the_time_of_its_row(tmp_path: Path) -> None:
    target = tmp_path / "fish.csv"
    words = ("--free", "--read-out", "30", "--rotate", "180")
    video = film(tmp_path, FilmedFish(), 2.0)
    assert fishctl("camera", "measure", str(video), *words, "--to", str(target)).returncode == 0
    table = pandas.read_csv(target)
    late = table.video_time - np.arange(50) / RATE
    assert late.to_numpy() == pytest.approx(
        (-0.030 * (table.y_px / 239 - 0.5)).to_numpy(), abs=2e-5
    )
