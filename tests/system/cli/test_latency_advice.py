"""Settings that `fishctl camera latency` suggests for frames of any age."""

from pathlib import Path

import pytest

from fishd.camera.latency import Latency
from fishd.camera.settings import CameraSettings, V4l2Settings
from fishd.camera.settings import load as load_camera
from fishd.cli.camera.latency import suggest_settings, suggest_stack_delay
from fishd.learning.settings import load as load_training

CAMERA = CameraSettings(source="v4l2", v4l2=V4l2Settings(delay=0.01))


def latency_of(stamps: float, latest: float) -> Latency:
    return Latency(stamps, 1e-3, latest - 5e-3, latest, 0.99, 900)


@pytest.mark.parametrize("latest", [0.02, 0.06, 0.1])
def test_young_frames_need_no_delay_of_a_stack(latest: float) -> None:
    assert suggest_stack_delay(latency_of(0.0, latest)) == 0.0
    assert suggest_settings(latency_of(0.0, latest), CAMERA) == [
        "its time stamps are right: nothing to set in the camera",
        "young enough for learning: nothing to set in a training",
    ]


def test_old_frames_need_one_that_can_be_pasted_into_the_file_of_a_training(tmp_path: Path) -> None:
    *_, where, block = suggest_settings(latency_of(0.0, 0.123), CAMERA)
    assert "for --settings" in where
    file = tmp_path / "training.yaml"
    file.write_text(block)
    assert load_training(file).camera.stack.delay == 0.125


def test_late_time_stamps_are_set_right_in_the_file_or_at_the_start(tmp_path: Path) -> None:
    where, block, command, _ = suggest_settings(latency_of(0.02, 0.04), CAMERA)
    assert where == "write into the file of the camera:"
    file = tmp_path / "camera.yaml"
    file.write_text(block)
    assert load_camera(file).v4l2.delay == pytest.approx(0.03)
    assert command == "or try: fishd-camera --set v4l2.delay=0.03"
