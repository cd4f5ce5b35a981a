"""Place, heading, speed, tail beat and Strouhal number of a fish that swims by itself."""

import json
from pathlib import Path

import numpy as np
import pandas
import pytest
from rigs.filmed_video import FilmedFish, write_video
from rigs.processes import fishctl, one_line

pytestmark = pytest.mark.slow
SECONDS, RATE, MM = 4.0, 25.0, 120.0


def film(path: Path, fish: FilmedFish, seconds: float = SECONDS) -> Path:
    return write_video(path / "fish.avi", fish.pictures(seconds, RATE), RATE)


@pytest.mark.parametrize(
    ("fish", "length", "scale"),
    [
        (FilmedFish(), None, 1.0),
        (FilmedFish(speed=22.0, turn=-0.1, water=60.0, body=180.0), MM, MM / 60.0),
        (FilmedFish(tag=7), 20.0, 1.0),
    ],
    ids=["dark", "light and slow", "tag"],
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
    # The centre follows the tail a little.
    assert 1.5 * fish.swing < result["excursion"] / scale < 2.0 * fish.swing
    product = result["frequency"] * result["excursion"] / result["mean_speed"]
    assert result["strouhal"] == pytest.approx(product)
    assert result["length"] == pytest.approx(scale * fish.length, rel=0.05)
    truth = scale * np.array([fish.place(time) for time in table.video_time])
    place = table[[f"x_{unit}", f"y_{unit}"]].to_numpy()
    assert np.nanstd(place - truth, axis=0).max() < 1.2 * scale
    known = table.heading.notna()
    assert known.sum() > 20
    heading = [fish.heading(time) for time in table.video_time[known]]
    assert table.heading[known].to_numpy() == pytest.approx(heading, abs=0.02)
    assert table[f"speed_{unit}"][known].mean() == pytest.approx(scale * fish.speed, rel=0.02)


@pytest.mark.parametrize(
    ("fish", "words", "message"),
    [
        (FilmedFish(speed=0.0, swing=0.0, turn=0.0), (), "nothing moves against a plain ground"),
        (FilmedFish(speed=500.0), (), "pictures: no fish is seen"),
        (FilmedFish(speed=0.0, turn=0.0), (), "the fish does not swim on; leave out --free"),
        (FilmedFish(), ("--tag", "3"), "the tag 3 is not seen"),
        (FilmedFish(), ("--learned", "a.bin"), "--learned is for a fish whose tail is measured"),
    ],
    ids=["at rest", "away", "held", "no tag", "an option for a tail"],
)
def test_what_is_not_seen_is_named_and_leaves_no_table(
    tmp_path: Path, fish: FilmedFish, words: tuple[str, ...], message: str
) -> None:
    video = film(tmp_path, fish, 2.0)
    target = tmp_path / "fish.csv"
    done = fishctl("camera", "measure", str(video), "--free", "--to", str(target), *words)
    assert message in one_line(done)
    assert not target.exists()
