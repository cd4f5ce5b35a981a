"""An argument that belongs elsewhere: the message names the place."""

from pathlib import Path

import pytest
from rigs.documents import ROOT
from rigs.policy_files import velocity_follower, write
from rigs.processes import fishctl, one_line


@pytest.mark.parametrize(
    "override", ["camera.feature_extractor=cnn", "ppo.n_steps=64", "see=camera"]
)
@pytest.mark.parametrize("verb", [("learn", "ppo"), ("compare", "swing")])
def test_a_message_on_a_training_names_its_file(verb: tuple[str, ...], override: str) -> None:
    done = fishctl(*verb, "--set", override)
    name = override.partition("=")[0].partition(".")[0]
    assert done.returncode == 78
    assert one_line(done) == (
        f"fishctl: --set {override}: --set is about the fish, {name} is a setting of a training: "
        "write it into a YAML file, for 'fishctl learn ppo --settings FILE'\n"
    )


@pytest.mark.parametrize("verb", [("compare",), ("policies", "show")])
@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ("{run}", "{run}: is the folder of a training, not a policy file; export it first: "),
        ("{run}/step-256", "{run}/step-256: is the folder of a training, not a policy file; exp"),
        ("{run}/step-256/model.zip", "model.zip: is part of a training, not a policy file; export"),
    ],
    ids=["a run", "its checkpoint", "the model of that"],
)
def test_a_run_in_place_of_a_policy_is_to_be_exported_first(
    tmp_path: Path, verb: tuple[str, ...], given: str, complaint: str
) -> None:
    (tmp_path / "step-256").mkdir()
    (tmp_path / "settings.yaml").touch()
    (tmp_path / "step-256" / "model.zip").write_bytes(b"PK")
    policy = given.format(run=tmp_path)
    line = one_line(fishctl(*verb, policy))
    assert complaint.format(run=tmp_path) in line
    assert line.endswith(f"fishctl learn export {policy.removesuffix('/model.zip')}\n")


def test_the_name_of_a_run_folder_is_known_without_a_slash_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "settings.yaml").touch()
    monkeypatch.chdir(tmp_path)
    line = one_line(fishctl("compare", "first"))
    assert line.startswith("fishctl: first is the folder of a training, not a policy file; ")


@pytest.fixture
def eye(tmp_path: Path) -> str:
    return str(write(tmp_path, velocity_follower(), "eye"))


def test_an_address_in_place_of_the_file_of_a_simulated_camera_is_refused(eye: str) -> None:
    for option in ("--camera-config", "--camera"):
        done = fishctl("compare", eye, option, "tcp://127.0.0.1:9875")
        assert one_line(done) == (
            "fishctl: 'tcp://127.0.0.1:9875' is the address of a running fishd-camera, which sees "
            "the fish of a running fishd; in simulation a simulated camera is needed, such as "
            "config/camera-web.yaml\n"
        )
        assert done.returncode == 78


def test_a_true_camera_cannot_see_a_simulated_fish(eye: str) -> None:
    file = ROOT / "config" / "camera.yaml"
    line = one_line(fishctl("compare", eye, "--camera-config", str(file)))
    assert line.startswith(f"fishctl: {file}: source is v4l2; in simulation a simulated camera")


@pytest.mark.parametrize("verb", ["status", "view --plot a.png", "align"])
def test_a_file_in_place_of_the_address_of_a_camera_is_refused(verb: str) -> None:
    line = one_line(fishctl("camera", *verb.split(), "--camera", "config/web.yaml"))
    assert line.startswith("fishctl: 'config/web.yaml' is a file, for 'fishd-camera --config' and")
    assert line.endswith("a running fishd-camera takes requests, such as tcp://127.0.0.1:9875\n")


def test_a_camera_that_no_contestant_looks_through_is_refused() -> None:
    done = fishctl(
        "compare", "swing", "hold", "--camera-config", str(ROOT / "config/camera-web.yaml")
    )
    assert done.returncode == 2
    assert "--camera-config cannot be given here: no contestant sees pictures" in one_line(done)
