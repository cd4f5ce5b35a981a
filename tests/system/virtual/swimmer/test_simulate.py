"""`fishctl simulate` of a swimmer: its output, its files, and its interruption and resumption."""

import json
import os
import pty
import re
import signal
import subprocess
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rigs.coarse_swimmer import OPTIONS
from rigs.processes import FISHCTL, PATIENCE, fishctl, one_line, sets

from fishd.virtual.swimmer import checkpoint
from fishd.virtual.swimmer.track import COLUMNS


def simulate(*words: str | Path) -> "subprocess.CompletedProcess[str]":
    return fishctl("simulate", *map(str, words), *OPTIONS)


def report(*words: str) -> dict[str, Any]:
    done = simulate(*words, "--json")
    assert done.returncode == 0, done.stderr
    figures: dict[str, Any] = json.loads(done.stdout)
    return figures


def table(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    with np.load(path) as archive:
        return {name: archive[name] for name in archive.files}


@pytest.fixture(scope="module")
def swum(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """A report of a square wave, and the folder with its files."""
    folder = tmp_path_factory.mktemp("swum")
    words = ("square", "--frequency", "2.5", "--for", "4", "--settle", "1")
    words = (*words, "--to", str(folder / "swim.npz"))
    return report(*words), folder


def test_the_figures_agree_with_one_another(swum: tuple[dict[str, Any], Path]) -> None:
    figures, folder = swum
    track = table(folder / "swim.npz")
    assert figures["frequency"] == pytest.approx(2.5)
    assert figures["beats"] == 6
    assert 0.0 < figures["speed"] < 0.2
    assert 0.0 < figures["speed_ci95"] < figures["speed"]
    assert 0.1 < figures["tail_width"] < 0.4
    assert 0.0 < figures["froude_efficiency"] < 1.0
    assert 0.0 < figures["water_power"] <= figures["muscle_power"]
    width = figures["tail_width"] * 0.1
    assert figures["strouhal"] == pytest.approx(2.5 * width / figures["speed"])
    assert {*COLUMNS, "midline_time", "midlines"} <= set(track)
    assert np.array_equal(track["midline_time"], track["time"])
    assert len(track["time"]) == figures["ticks"] == 400
    assert set(track["activation"]) == {0.0, 1.0, -1.0}
    settled = track["time"] > 1.0
    speed = -np.polyfit(track["time"][settled], track["x"][settled], 1)[0]
    assert speed == pytest.approx(figures["speed"], rel=0.15)


def test_a_person_gets_the_same_in_a_few_lines() -> None:
    out = simulate("swing", "--seconds", "2.5", "--settle", "0.5").stdout
    for word in ("speed", "frequency", "heading", "tail", "power", "cost", "Strouhal", "Froude"):
        assert f"\n{word} " in out
    assert "whole beats" in out


def test_a_table_is_a_row_for_each_tick_in_either_form(tmp_path: Path) -> None:
    for name in ("a.csv", "b.npz"):
        words = ("sine", "--seconds", "0.3", "--settle", "0.1", "--to", tmp_path / name)
        assert simulate(*words).returncode == 0
    rows = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    arrays = table(tmp_path / "b.npz")
    for name in COLUMNS:
        assert rows[name] == pytest.approx(arrays[name], rel=1e-6, abs=1e-9)


def test_a_swim_goes_on_from_a_checkpoint_to_the_last_bit(tmp_path: Path) -> None:
    hold = ("hold", "--angle", "0.3", "--settle", "0.1")
    whole, parts = tmp_path / "whole.npz", tmp_path / "parts.npz"
    assert simulate(*hold, "--for", "0.6", "--to", whole).returncode == 0
    assert simulate(*hold, "--for", "0.4", "--to", parts).returncode == 0
    done = fishctl("simulate", "--resume", str(parts), "--for", "0.6", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["resumed"] == pytest.approx(0.4)
    expected, resumed = table(whole), table(parts)
    for name in (*COLUMNS, "midline_time", "midlines"):
        assert np.array_equal(expected[name], resumed[name]), name


def test_a_swim_of_another_controller_begins_where_one_ended(
    swum: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    before = (swum[1] / "swim.npz").read_bytes()
    words = ("hold", "--for", "0.3", "--settle", "0.1", "--resume", swum[1] / "swim.npz")
    line = one_line(simulate(*words, "--to", swum[1] / "swim.npz"))
    assert "this swim is of another controller or of other parameters; give another file" in line
    assert simulate(*words, "--to", tmp_path / "next.npz").returncode == 0
    assert table(tmp_path / "next.npz")["time"][0] == pytest.approx(4.01)
    assert (swum[1] / "swim.npz").read_bytes() == before


def test_a_swim_that_is_as_long_already_leaves_its_file_alone(
    swum: tuple[dict[str, Any], Path],
) -> None:
    kept = swum[1] / "swim.npz"
    before = kept.read_bytes()
    line = one_line(fishctl("simulate", "--resume", str(kept)))
    assert line == f"fishctl: {kept}: this swim is 4.00 s long already; give a longer --for\n"
    assert kept.read_bytes() == before


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("swimmer.muscle.strain=0.5", "swimmer.muscle.strain 1.0, and here it is 0.5"),
        ("swimmer.muscle.servo=true", "swimmer.muscle.servo false, and here it is true"),
        ("amplitude_limit=0.3", "amplitude_limit 0.42, and here it is 0.3"),
    ],
)
def test_a_checkpoint_of_another_fish_is_refused_with_the_key_that_differs(
    swum: tuple[dict[str, Any], Path], override: str, complaint: str
) -> None:
    kept = str(swum[1] / "swim.npz")
    line = one_line(simulate("swing", "--resume", kept, "--set", override))
    assert line.startswith(f"fishctl: {kept}: it is of a swim with {complaint}")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 nor this"])
def test_what_is_no_checkpoint_is_said_to_be_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "kept").write_bytes(content)
    line = one_line(simulate("swing", "--resume", str(tmp_path / "kept")))
    assert line == f"fishctl: {tmp_path}/kept: it is not a swim of 'fishctl simulate --to'\n"


@pytest.mark.parametrize(
    ("name", "change", "complaint"),
    [
        ("state.u", lambda u: u[:1], r"of another version of fishd, and does not fit \('u'\)"),
        ("state.p", lambda p: p.astype(complex), r"of another version .* does not fit \('p'\)"),
        ("x", lambda x: x[:0], "not a swim of 'fishctl simulate --to'"),
    ],
)
def test_a_swim_with_other_arrays_is_refused(
    swum: tuple[dict[str, Any], Path],
    tmp_path: Path,
    name: str,
    change: Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]],
    complaint: str,
) -> None:
    arrays = table(swum[1] / "swim.npz")
    other = tmp_path / "kept.npz"
    np.savez(other, **arrays | {name: np.asarray(change(arrays[name]))})
    line = one_line(simulate("sine", "--for", "0.2", "--settle", "0.1", "--resume", other))
    assert re.match(rf"fishctl: {other}: it is {complaint}", line)


def test_a_checkpoint_that_would_fill_the_memory_is_not_unpacked(
    swum: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    bomb = tmp_path / "bomb.npz"
    with zipfile.ZipFile(bomb, "w") as archive:
        archive.writestr("state.u.npy", b"")
        # The directory holds the unpacked size, and no more than the directory may be read.
        archive.getinfo("state.u.npy").file_size = 2**30 + 1
    with pytest.raises(checkpoint.CheckpointError, match="it would be longer than 1024 MB"):
        checkpoint.load(bomb)


def test_a_checkpoint_whose_track_has_other_columns_is_said_to_be_of_another_version(
    swum: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    arrays = table(swum[1] / "swim.npz")
    about = json.loads(str(arrays["about"]))
    about["columns"].append("depth")
    np.savez(tmp_path / "kept.npz", **arrays | {"about": np.array(json.dumps(about))})
    with pytest.raises(checkpoint.CheckpointError, match="of another version of fishd, whose"):
        checkpoint.load(tmp_path / "kept.npz")


def test_a_swim_that_is_not_steady_is_said_to_need_a_longer_settle() -> None:
    out = simulate("square", "--frequency", "2.5", "--seconds", "2.5", "--settle", "0").stdout
    assert "\n            still speeding up by " in out
    assert " %/s: a longer --settle is needed\n" in out


def test_a_fish_that_cannot_go_on_says_why_and_where_its_last_checkpoint_is(tmp_path: Path) -> None:
    kept = tmp_path / "kept.npz"
    keeps = ("--to", str(kept), "--checkpoint-every", "0.1")
    body = ("swimmer.body.young=1e4", "swimmer.body.viscosity=1e-4", "estimator.kind=sensor")
    narrow = sets("swimmer.numerics.fine_width=0.5", "swimmer.steering=0", *body)
    done = fishctl("simulate", "square", "--frequency", "1", *OPTIONS, *narrow, *keeps)
    line = one_line(done)
    assert done.returncode == 1
    assert "the swimmer cannot go on at" in line
    last = checkpoint.load(kept)
    assert line.endswith(
        f"its last checkpoint is at {last.time:.2f} s; resume with: fishctl simulate "
        f"--resume {kept}\n"
    )


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--to", "track.txt"), "track.txt: a name that ends in .csv or .npz is needed"),
        (("--to", "no-such/track.csv"), "there is no folder no-such"),
        (("--film", "no-such/f.gif"), "no-such/f.gif: its folder does not exist; create it"),
        (("--seconds", "2", "--settle", "3"), "a run of 2 s is too short"),
        (("--film", "/dev/null"), "/dev/null: is a device; a regular file is needed"),
    ],
)
def test_what_cannot_be_done_is_said_before_a_swim(words: tuple[str, ...], complaint: str) -> None:
    assert complaint in one_line(simulate("swing", *words))


def test_the_file_of_another_swim_is_kept(swum: tuple[dict[str, Any], Path]) -> None:
    kept = swum[1] / "swim.npz"
    before = kept.read_bytes()
    line = one_line(simulate("swing", "--to", kept))
    assert line == f"fishctl: {kept} exists: --resume it, or give another file\n"
    assert kept.read_bytes() == before


def test_a_folder_that_goes_away_costs_its_file_and_not_the_swim(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    save = checkpoint.save

    def save_and_go(*given: Any) -> None:
        save(*given)
        gone.rename(tmp_path / "elsewhere")

    monkeypatch.setattr(checkpoint, "save", save_and_go)
    files = ("--to", gone / "kept.npz", "--checkpoint-every", "0.3")
    wave = ("square", "--frequency", "5", "--seconds", "0.8", "--settle", "0.2")
    done = simulate(*wave, *files)
    assert (tmp_path / "elsewhere" / "kept.npz").exists()
    assert done.returncode == 1
    assert "\nspeed " in done.stdout
    assert done.stderr.splitlines()[-1] == (
        f"fishctl: {gone}/kept.npz: the swim cannot be written: No such file or directory; the "
        "fish swims on"
    )


def test_ctrl_c_keeps_what_was_swum_and_the_bar_shows_the_speed(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    kept = tmp_path / "kept.npz"
    files = ("--to", str(kept), "--checkpoint-every", "0.1")
    command = (FISHCTL, "simulate", "swing", "--seconds", "500", *OPTIONS, *files)
    swimming = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=theirs)
    os.close(theirs)
    deadline = time.monotonic() + PATIENCE
    while not kept.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    swimming.send_signal(signal.SIGINT)
    seen = b""
    try:
        while chunk := os.read(ours, 4096):
            seen += chunk
    except OSError:  # the other end is closed
        pass
    os.close(ours)
    assert swimming.wait(PATIENCE) == 130
    assert "mm/s" in seen.decode()
    assert "interrupted; its last checkpoint is at" in seen.decode()
    assert len(checkpoint.load(kept).track) >= 10


def test_a_recording_has_where_the_fish_was(tmp_path: Path) -> None:
    path = tmp_path / "swim.mcap"
    words = ("--seconds", "0.3", "--settle", "0.1", "--record", str(path))
    assert simulate("square", *words).returncode == 0
    done = fishctl("export", str(path), "--csv", "--to", str(tmp_path))
    assert done.returncode == 0
    header = (tmp_path / "swim.csv").read_text().partition("\n")[0].split(",")
    assert {"x", "y", "speed", "heading"} <= set(header)
