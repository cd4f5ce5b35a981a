"""Calibration of the lens of a real fishd-camera, before which a board is held."""

import re
import signal
import subprocess
from pathlib import Path

import msgspec
import pytest
from rigs.camera_process import running_camera
from rigs.filmed_board import SQUARE_MM, FilmedBoard, calibrate
from rigs.filmed_tail import Film
from rigs.filmed_video import write_video
from rigs.processes import FISHCTL, Process, fishctl, one_line

from fishd.camera.messages import CameraState
from fishd.camera.tail.lens import Lens
from fishd.core.errors import Refused

pytestmark = pytest.mark.slow
FILM = Film(width=480, height=360, lens=-0.12, tilt=0.1)
RATE_HZ = 10.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with videos of a board that is held still again and again, and that lies."""
    folder, board = tmp_path_factory.mktemp("board"), FilmedBoard(FILM)
    held = [picture for picture in board.held() for _ in range(10)]
    write_video(folder / "held.avi", held, RATE_HZ)
    write_video(folder / "lying.avi", [board.lying()] * 20, RATE_HZ)
    return folder


def lens(endpoint: str, *words: str) -> subprocess.CompletedProcess[str]:
    return fishctl("camera", "lens", "--camera", endpoint, *words)


def test_lens_and_plane_are_calibrated_one_after_the_other(folder: Path) -> None:
    settings = ("source=stream", f"tail.learned={folder}/tail.bin")
    with running_camera(folder, *settings, f"stream.url={folder}/held.avi") as camera:
        camera.is_in("streaming")
        refused = one_line(lens(camera.endpoint, "--plane"))
        assert "its lens is not calibrated: run 'fishctl camera lens'" in refused
        done = lens(camera.endpoint)
        assert done.returncode == 0, done.stderr
        assert re.search(r"view \d+ of at least 10 is taken: show the board at the ", done.stderr)
        assert "error 0." in camera.status().lens
        assert "plane" not in camera.status().lens
    with running_camera(folder, *settings, f"stream.url={folder}/lying.avi") as camera:
        camera.is_in("streaming")
        assert "error 0." in camera.status().lens
        done = lens(camera.endpoint, "--plane", "--square", str(SQUARE_MM))
        assert "plane of the tail 0." in done.stdout
        assert (
            "plane of the tail 0."
            in fishctl("camera", "status", "--camera", camera.endpoint).stdout
        )
    calibration = Lens.load(folder / "tail.lens.json")
    assert calibration.size == (480, 360)
    assert calibration.focal == pytest.approx((480.0, 480.0), rel=0.01)
    assert calibration.pixels_per_mm == pytest.approx(0.08 * 480 / SQUARE_MM, rel=0.01)


def test_an_interrupted_calibration_changes_nothing(folder: Path, tmp_path: Path) -> None:
    settings = ("source=stream", f"stream.url={folder}/lying.avi", f"tail.learned={tmp_path}/t.bin")
    with running_camera(tmp_path, *settings) as camera:
        camera.is_in("streaming")
        with Process(FISHCTL, "camera", "lens", "--camera", camera.endpoint) as process:
            assert process.process.stderr
            assert "view 1 of at least 10 is taken" in process.process.stderr.readline()
            status, _, said = process.end(signal.SIGINT)
        assert (status, camera.status().lens) == (130, "")
        assert "interrupted: nothing is calibrated" in said


def test_a_camera_without_views_is_not_calibrated(folder: Path, tmp_path: Path) -> None:
    settings = ("source=stream", f"stream.url={folder}/lying.avi", "publish.view_rate=0")
    with running_camera(tmp_path, *settings) as camera:
        camera.is_in("streaming")
        refused = one_line(lens(camera.endpoint))
        assert "set publish.view_rate of the camera to 2 or more" in refused


def test_a_calibration_that_no_camera_has_is_refused(folder: Path, tmp_path: Path) -> None:
    whole = msgspec.to_builtins(calibrate(FILM))
    settings = ("source=stream", f"stream.url={folder}/lying.avi", f"tail.learned={tmp_path}/t.bin")
    with running_camera(tmp_path, *settings) as camera, camera.client() as client:
        for change, message in (
            ({"focal": [0.0, 480.0]}, "size and focal length must be at least a pixel"),
            ({"date": None}, "Expected `str`, got `null`"),
            (
                {"rotate": 90},
                "turned by 0°, but the lens was calibrated with pictures turned by 90",
            ),
        ):
            with pytest.raises(Refused, match=message):
                client.requests._call(CameraState, "set_lens", args=whole | change)
        assert client.status().lens == ""
