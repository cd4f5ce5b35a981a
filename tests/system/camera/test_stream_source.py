"""A video file as a camera, through OpenCV."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from rigs.camera_process import running_camera
from rigs.processes import PATIENCE
from rigs.v4l2_kernel import level, picture


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve pictures at 50 a second."""
    file = tmp_path_factory.mktemp("video") / "fish.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 50.0, (160, 120))
    for number in range(12):
        writer.write(cv2.cvtColor(picture(number, 160, 120), cv2.COLOR_GRAY2BGR))
    writer.release()
    return file


@pytest.mark.realtime
def test_a_file_is_played_at_its_own_rate_again_and_again(tmp_path: Path, video: Path) -> None:
    with (
        running_camera(tmp_path, "source=stream", f"stream.url={video}") as camera,
        camera.client() as client,
    ):
        frames = []
        while len(frames) < 60:
            frames += client.poll(PATIENCE)
        state = client.status()
    levels = [round(float(np.median(frame.pixels[:, 5:35])) / 10) * 10 for frame in frames]
    numbers = [(grey - level(0)) // 10 for grey in levels]
    assert all(after == (before + 1) % 12 for before, after in pairwise(numbers))
    # After a stall of the machine, frames catch up, so the longest time of 30 frames is judged.
    longest = max(b.time - a.time for a, b in zip(frames[:-29], frames[29:], strict=True))
    assert longest >= 29 / 50.0 - 0.03
    assert state.limitations == ("times are those of playback: a file has no times of exposure",)
    assert (state.picture_width, state.picture_height) == (160, 120)


def test_a_file_that_is_not_repeated_ends(tmp_path: Path, video: Path) -> None:
    pairs = ("source=stream", f"stream.url={video}", "stream.loop=false", "stream.rate=200")
    with running_camera(tmp_path, *pairs) as camera:
        state = camera.is_in("ended")
    assert state.seq == 12


@pytest.mark.parametrize("content", [b"", b"no video at all\n" * 100])
def test_a_file_that_is_no_video_is_said(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "fish.avi"
    file.write_bytes(content)
    with running_camera(tmp_path, "source=stream", f"stream.url={file}") as camera:
        assert camera.is_in("unusable").problem == f"{file} is not a video"


@contextmanager
def serving(folder: Path, port: int = 0) -> Iterator[int]:
    """Serve the files of a folder over HTTP; yield the port."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", port), handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


def test_a_network_camera_that_goes_and_comes_back_is_followed(tmp_path: Path, video: Path) -> None:
    with serving(video.parent) as port:
        url = f"http://127.0.0.1:{port}/{video.name}"
        with running_camera(tmp_path, "source=stream", f"stream.url={url}") as camera:
            first = camera.until(lambda state: state.seq > 3)
            assert "times are those of arrival" in first.limitations[0]
            state = camera.is_in("stalled")
            assert "it is opened again" in state.problem
            camera.until(lambda state: state.session != first.session)


def test_an_absent_network_camera_is_looked_for_and_its_password_kept(tmp_path: Path) -> None:
    url = "rtsp://me:secret@127.0.0.1:9/fish"
    with running_camera(tmp_path, "source=stream", f"stream.url={url}") as camera:
        state = camera.is_in("unplugged")
        with camera.client() as client:
            settings = client.settings()
        _, _, log = camera.end()
    assert state.device == "rtsp://127.0.0.1:9/fish"
    assert settings.stream.url == "rtsp://127.0.0.1:9/fish"
    assert "rtsp://127.0.0.1:9/fish cannot be opened" in state.problem
    assert "secret" not in log
