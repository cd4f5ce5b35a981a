"""Training on the pictures of a simulated camera instead of on forces."""

import shutil
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Literal

import gymnasium
import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from rigs.pictures import WEB
from rigs.swimming import brief_job, rows

from fishd.camera.axis import NoMotion
from fishd.camera.simulated import DEFAULT, SimulatedCameraSettings
from fishd.config import Config
from fishd.core.camera_frames import StackSettings
from fishd.learning.env import environment
from fishd.learning.env.environment import SwimEnv
from fishd.learning.extractors import FeatureExtractor, make_extractor
from fishd.learning.links.simulated_link import Camera, SimulatedLink
from fishd.learning.run_folder import checkpoints, runs
from fishd.learning.run_folder.checkpoints import CheckpointError
from fishd.learning.settings import (
    EnvironmentSettings,
    EvaluationSettings,
    TrainingSettings,
    VisionSettings,
    check,
)
from fishd.learning.train.jobs import Job, Outcome
from fishd.learning.train.training import train

BRIEF = EvaluationSettings(seconds=6.0, settle=2.0)


def job_of(
    folder: Path, extractor: str = "modes", steps: int = 384, rig: SimulatedCameraSettings = DEFAULT
) -> Job:
    settings = TrainingSettings(
        see="camera",
        steps=steps,
        camera=VisionSettings(feature_extractor=extractor),
        evaluation=BRIEF,
    )
    return replace(brief_job(folder), settings=settings, camera=rig)


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory) -> tuple[Job, Outcome]:
    """A training with a random excitation and two updates; its folder must not be changed."""
    job = job_of(tmp_path_factory.mktemp("pictures") / "first")
    return job, train(job)


@pytest.mark.slow
@pytest.mark.parametrize("rig", [DEFAULT, WEB])
def test_a_policy_swims_by_sight_after_a_thousand_steps(
    tmp_path: Path, by_sight: Outcome, rig: SimulatedCameraSettings
) -> None:
    job = job_of(tmp_path / "run", steps=1024, rig=rig)
    outcome = by_sight if rig == DEFAULT else train(job)
    assert (outcome.ended, outcome.steps) == ("finished", 1024)
    assert outcome.best_evaluation.relative_thrust > 0.9


@pytest.mark.parametrize(
    ("extractor", "size", "see"),
    [("cnn", 68, "camera"), ("nature", 36, "camera"), ("modes", 16, "both")],
)
def test_with_the_smallest_frames_each_eye_learns_from_whole_rollouts(
    tmp_path: Path, extractor: str, size: int, see: Literal["camera", "both"]
) -> None:
    job = job_of(tmp_path / "run", extractor)
    few = replace(job.settings.ppo, n_epochs=2)
    small = replace(job.settings.camera, stack=StackSettings(size=size))
    settings = replace(job.settings, see=see, ppo=few, camera=small)
    check(settings)
    outcome = train(replace(job, settings=settings))
    assert (outcome.ended, outcome.steps) == ("finished", 384)
    assert outcome.latest_evaluation


def test_the_same_seed_gives_the_same_by_sight(tmp_path: Path, brief: tuple[Job, Outcome]) -> None:
    again = train(job_of(tmp_path / "again"))
    for table in ("progress.csv", "evaluations.csv"):
        assert (again.folder / table).read_bytes() == (brief[0].folder / table).read_bytes()


def test_the_babble_counts_as_steps(brief: tuple[Job, Outcome]) -> None:
    assert [row["steps"] for row in rows(brief[0].folder / "evaluations.csv")] == [
        "256",
        "320",
        "384",
    ]
    assert brief[1].tank_time > 384 * 0.05


def test_a_resumed_run_keeps_its_eye(tmp_path: Path, brief: tuple[Job, Outcome]) -> None:
    folder = shutil.copytree(brief[0].folder, tmp_path / "run")
    _, before = checkpoints.load_policy(folder / "step-000384")
    job = replace(brief[0], folder=folder, resume=True)
    longer = replace(job, settings=replace(job.settings, steps=512))
    outcome = train(longer)
    assert outcome.steps == 512
    _, after = checkpoints.load_policy(folder / "step-000512")
    assert before.extractor
    assert after.extractor
    patterns = [model.extractor.constants["patterns"] for model in (before, after)]
    assert np.array_equal(*patterns)


def test_a_run_folder_contains_the_settings_of_its_camera(tmp_path: Path) -> None:
    job = job_of(tmp_path / "run", steps=256, rig=replace(WEB, seed=3))
    train(replace(job, settings=replace(job.settings, steps=257)))
    stored = runs.read_camera(job.folder)
    assert all(getattr(stored, name) == value for name, value in fields(job.camera).items())


def fields(rig: SimulatedCameraSettings) -> dict[str, object]:
    return {name: getattr(rig, name) for name in SimulatedCameraSettings.__struct_fields__}


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (TrainingSettings(), "its see is camera, that of this training is force"),
        (
            TrainingSettings(see="camera", camera=VisionSettings(modes=3)),
            "its camera.modes is 4, that of this training is 3; feature extractor and "
            "networks must be alike",
        ),
        (TrainingSettings(see="both"), "its see is camera, that of this training is both"),
    ],
)
def test_networks_are_not_given_to_another_eye(
    tmp_path: Path, brief: tuple[Job, Outcome], change: TrainingSettings, complaint: str
) -> None:
    parent = checkpoints.find(brief[0].folder)
    with pytest.raises(CheckpointError, match=complaint):
        train(Job(config=Config(), settings=change, folder=tmp_path / "new", parent=parent))
    assert not (tmp_path / "new").exists()


def packed(**constants: list[float]) -> bytes:
    arrays = {name: np.array(value, np.float32) for name, value in constants.items()}
    stored = {name: checkpoints.Constant(a.shape, a.tobytes()) for name, a in arrays.items()}
    return msgspec.msgpack.encode(stored)


HOSTILE = msgspec.msgpack.encode({"zero": checkpoints.Constant((10**12,), b"1234")})


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK",
        b"\x81" * 10_000,
        HOSTILE,
        packed(zero=[1.0]),
        packed(zero=[0.0] * 4, patterns=[[0.0] * 7056] * 3),
        packed(zero=[float("nan")] * 4, patterns=[[0.0] * 7056] * 4),
    ],
)
def test_an_eye_that_cannot_be_read_is_an_error_with_advice(
    tmp_path: Path, brief: tuple[Job, Outcome], content: bytes
) -> None:
    folder = shutil.copytree(brief[0].folder, tmp_path / "run")
    path = folder / "step-000384" / "eye.msgpack"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"eye\.msgpack: .*move this checkpoint away"):
        checkpoints.load_policy(path.parent)


def test_a_training_whose_camera_sees_no_tail_ends_with_an_explanation(tmp_path: Path) -> None:
    blind = replace(DEFAULT, contrast=0.1)
    with pytest.raises(NoMotion, match="see that the camera looks at its tail"):
        train(job_of(tmp_path / "run", rig=blind))


def test_steps_without_a_frame_are_void() -> None:
    rare = replace(DEFAULT, rate=3.0)
    camera = Camera(rare, StackSettings(frames=1))
    link = SimulatedLink(Config(), camera=camera)
    env = SwimEnv(link, Config(), EnvironmentSettings(), job_extractor("nature"))
    env.reset(seed=0)
    action = np.array([0.2], np.float32)
    steps = [env.step(action) for _ in range(100)]
    blind = [info["blind"] for *_, info in steps]
    assert 0.3 < np.mean(blind) < 0.7
    assert [truncated for *_, truncated, _ in steps] == [bool(is_blind) for is_blind in blind]


def test_a_training_whose_camera_is_too_late_ends_with_an_explanation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The training waits in real time, too, which here runs as fast as that of the fish.
    monkeypatch.setattr(environment, "time", SimpleNamespace(monotonic=count(0.0, 0.05).__next__))
    job = job_of(tmp_path / "run", rig=replace(DEFAULT, rate=5.0))
    outcome = train(job)
    assert outcome.ended == "lost"
    assert "the camera has shown no whole stack of frames for 5 s" in outcome.message
    assert "give that a larger delay or oldest" in outcome.message


def test_with_another_camera_only_the_eye_is_fitted(tmp_path: Path, by_sight: Outcome) -> None:
    again = job_of(tmp_path / "again", steps=512, rig=WEB)
    outcome = train(replace(again, parent=by_sight.best))
    assert outcome.best_evaluation.relative_thrust > 0.9
    saved = (by_sight.best, outcome.best)
    extractors = [checkpoints.load_policy(step)[1].extractor for step in saved]
    first, second = (extractor.constants["patterns"] for extractor in extractors if extractor)
    assert not np.array_equal(first, second)


def job_extractor(kind: str) -> FeatureExtractor | None:
    stack = StackSettings(frames=1)
    camera = VisionSettings(feature_extractor=kind, stack=stack)
    return make_extractor(TrainingSettings(see="camera", camera=camera))


def test_gymnasium_makes_an_environment_that_sees(tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("see: both\n", encoding="utf-8")
    env = gymnasium.make("fishd/Swim-v0", settings=file)
    seen, _ = env.reset(seed=1)
    assert seen.shape == (16 + 5,)
    assert np.count_nonzero(seen[:16]) == 16
    env.close()
