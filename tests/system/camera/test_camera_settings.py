"""Settings of `fishd-camera`: an error is one line that names its place."""

from pathlib import Path

import pytest
import yaml
from rigs.camera_process import COMMAND
from rigs.documents import ROOT
from rigs.processes import call, one_line

from fishd.camera import main
from fishd.camera.settings import CameraSettings, SimulatedSettings, hide_secrets, load
from fishd.core.errors import ConfigError


@pytest.mark.parametrize("name", ["camera.yaml", "camera-simulated.yaml", "camera-web.yaml"])
def test_the_examples_are_valid(name: str) -> None:
    settings = load(ROOT / "config" / name)
    assert settings.source == ("v4l2" if name == "camera.yaml" else "simulated")


def test_the_good_simulated_camera_is_the_default() -> None:
    assert load(ROOT / "config/camera-simulated.yaml") == CameraSettings()
    good = yaml.safe_load((ROOT / "config/camera-simulated.yaml").read_text())["simulated"]
    assert set(good) == set(SimulatedSettings.__struct_fields__)


@pytest.mark.parametrize(
    ("override", "why"),
    [
        ("source=usb", "one of simulated | stream | v4l2 is needed"),
        ("source=stream", "stream.url: is missing"),
        ("picture.size=1000", "a whole number in [16, 256] px is needed"),
        ("publish.requests=tcp://127.0.0.1:9874", "is that of frames already"),
        ("simulated.fishd=tcp://127.0.0.1:*", "is not valid"),
        ("v4l2.controls.gain=1.5", "a whole number, true or false is needed"),
        ("picture.crop.size=1", "unknown key"),
        ("stream.url=gopher://host/video", "rtsp"),
    ],
)
def test_a_wrong_value_is_named(override: str, why: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, [override])
    assert str(caught.value).count("\n") == 0
    assert why in str(caught.value)


def test_a_wrong_file_is_named_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text("source: v4l2\nv4l2:\n  widht: 640\n")
    done = call(*COMMAND, "--config", str(file))
    assert done.returncode == 78
    assert f"{file}:3: v4l2.widht: unknown key" in one_line(done)


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("/videos/fish.mp4", "/videos/fish.mp4"),
        ("rtsp://me:secret@10.0.0.5:554/fish", "rtsp://10.0.0.5:554/fish"),
        ("http://10.0.0.5/video.cgi?user=me&pwd=secret", "http://10.0.0.5/video.cgi?user=…&pwd=…"),
        (
            "rtsp://10.0.0.5/user=me&password=secret&channel=1/0.sdp",
            "rtsp://10.0.0.5/user=…&password=…&channel=…/0.sdp",
        ),
    ],
)
def test_nobody_is_told_a_password_wherever_a_camera_wants_it(url: str, shown: str) -> None:
    assert hide_secrets(url) == shown


@pytest.mark.parametrize(
    ("url", "mode", "warns"),
    [
        ("rtsp://me:secret@host/", 0o644, True),
        ("rtsp://me:secret@host/", 0o640, False),
        ("rtsp://host/", 0o644, False),
    ],
)
def test_a_password_that_every_user_can_read_is_warned_of(
    url: str, mode: int, warns: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text(f"source: stream\nstream: {{url: '{url}'}}\n")
    file.chmod(mode)
    main.warn_of_readers(file, load(file))
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == warns
    assert all("every user of this machine can read it: run chmod 640" in line for line in lines)
    assert "secret" not in "".join(lines)
