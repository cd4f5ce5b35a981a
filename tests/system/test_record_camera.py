"""`fishctl record --camera` on a real fishd and a real fishd-camera, also one that is killed."""

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rigs.camera_process import CameraProcess, running_camera
from rigs.processes import FISHCTL, Daemon, Process, fishctl, one_line, wait_until

from fishd.cli.recording.record import INCOMPLETE
from fishd.core.camera_frames import FrameHead
from fishd.core.errors import RecordingError
from fishd.recording import open_run


@pytest.fixture
def camera(shared_daemon: Daemon, tmp_path: Path) -> Iterator[CameraProcess]:
    with running_camera(tmp_path, *watching(shared_daemon)) as camera:
        camera.is_in("streaming")
        yield camera


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "runs"
    folder.mkdir()
    monkeypatch.setenv("FISHD_RUNS", str(folder))
    return folder


def watching(daemon: Daemon) -> tuple[str, ...]:
    return (f"simulated.fishd={daemon.endpoint}", "simulated.rate=30")


def heads_in(folder: Path) -> list[FrameHead]:
    try:
        return open_run(next(folder.glob("*.part"))).frame_heads
    except (StopIteration, RecordingError):
        return []


def recording(daemon: Daemon, camera: CameraProcess) -> Process:
    words = ("--endpoint", daemon.endpoint, "record", "run")
    return Process(FISHCTL, *words, "--camera", camera.endpoint)


def test_frames_and_forces_are_in_one_file_on_one_clock(
    daemon: Daemon, camera: CameraProcess, runs: Path
) -> None:
    process = recording(daemon, camera)
    wait_until(lambda: len(heads_in(runs)) > 40)
    status, out, _ = process.end(signal.SIGINT)
    assert status == 0
    assert re.search(r"^run\.mcap: [0-9.]+ s, \d+ ticks, 0 lost, \d+ frames, 0 lost, ", out, re.M)
    run = open_run(runs / "run.mcap")
    frames = list(run.frames())
    assert run.finished
    assert {frame.pixels.shape for frame in frames} == {(84, 84)}
    assert np.diff([frame.time for frame in frames]) == pytest.approx(1 / 30, abs=1e-3)
    ahead = [tick.t - tick.time for tick in run.ticks]
    for frame in frames:
        assert min(ahead) - 1e-3 < frame.t - frame.time < max(ahead) + 1e-3
        assert 0.03 <= frame.available - frame.time < 10.0
    listed = fishctl("runs").stdout
    assert f"{len(frames)} frames" in listed
    assert "lost" not in listed.splitlines()[1]


def test_a_camera_that_dies_ends_nothing_and_is_recorded_again_once_it_is_back(
    daemon: Daemon, camera: CameraProcess, runs: Path, tmp_path: Path
) -> None:
    process = recording(daemon, camera)
    wait_until(lambda: len(heads_in(runs)) > 10)
    camera.end(signal.SIGKILL)
    wait_until(lambda: "no frames come" in marks_in(runs))
    sessions = {head.session for head in heads_in(runs)}
    with running_camera(tmp_path, *watching(daemon)):
        wait_until(lambda: {head.session for head in heads_in(runs)} > sessions)
        wait_until(lambda: "is back" in marks_in(runs))
    status, _, complaints = process.end(signal.SIGINT)
    assert status == INCOMPLETE
    assert (
        "fishctl: no frames come from the camera: it does not answer; the recording continues"
        in (complaints.splitlines())
    )
    assert "fishctl: the camera is back: its frames are recorded" in complaints.splitlines()
    run = open_run(runs / "run.mcap")
    assert run.summary.frame_gaps >= 1
    assert run.gaps == []
    assert "gap" in fishctl("runs").stdout


def marks_in(folder: Path) -> str:
    try:
        run = open_run(next(folder.glob("*.part")))
    except (StopIteration, RecordingError):
        return ""
    return "\n".join(event.message for event in run.events if event.kind == "mark")


def test_a_recording_with_a_camera_does_not_begin_without_one(
    daemon: Daemon, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FISHD_CAMERA", f"ipc://{tmp_path}/nobody")
    assert "no camera at" in one_line(daemon.fishctl("record", "run", "--camera"))
    assert not list(runs.iterdir())


def test_what_follows_the_option_is_the_camera_only_where_it_is_an_address(
    daemon: Daemon, camera: CameraProcess, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for words in (("--camera", camera.endpoint, "first"), ("--camera", "second")):
        process = Process(FISHCTL, "--endpoint", daemon.endpoint, "record", *words)
        wait_until(lambda: bool(heads_in(runs)))
        status, _, complaints = process.end(signal.SIGINT)
        assert status == 0, complaints
        assert open_run(runs / f"{words[-1]}.mcap").frame_heads
        monkeypatch.setenv("FISHD_CAMERA", camera.endpoint)
    refused = one_line(daemon.fishctl("record", "third", "--camera", "config/camera.yaml"))
    assert "'config/camera.yaml' is a file" in refused


def test_a_black_box_keeps_no_frames(daemon: Daemon, runs: Path) -> None:
    complaint = one_line(daemon.fishctl("record", "--black-box", "--camera"))
    assert "a black box keeps no frames: they would fill it within hours" in complaint
