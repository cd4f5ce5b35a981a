"""The export of policies that see pictures, together with their feature extractors."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from msgspec.structs import replace
from rigs.seeing_policies import randomly_excited
from stable_baselines3 import PPO

from fishd.camera.simulated import DEFAULT
from fishd.cli.main import fishctl
from fishd.config import Config
from fishd.controllers.policy import file
from fishd.controllers.policy.file import PolicyFile
from fishd.controllers.policy.network import to_onnx
from fishd.controllers.policy.runtime import Network, Pilot
from fishd.core.camera_frames import StackSettings
from fishd.core.errors import PolicyError
from fishd.lab.compare import compare
from fishd.learning import export as exporting
from fishd.learning.env.environment import SwimEnv
from fishd.learning.export import export, export_model
from fishd.learning.extractors import random_angles
from fishd.learning.links.simulated_link import Camera, SimulatedLink
from fishd.learning.ppo import DeterministicPolicy, activation_of, layers_of
from fishd.learning.settings import (
    EnvironmentSettings,
    PpoSettings,
    TrainingSettings,
    VisionSettings,
)
from fishd.learning.train.jobs import Outcome


def settings_of(extractor: str, **values: Any) -> TrainingSettings:
    ppo = PpoSettings(symmetric=values.pop("symmetric", True))
    stack = StackSettings(size=values.pop("size", 84), frames=values.pop("frames", 4))
    vision = VisionSettings(feature_extractor=extractor, stack=stack)  # type: ignore[arg-type]
    return TrainingSettings(camera=vision, ppo=ppo, **({"see": "camera"} | values))


CASES = [
    settings_of("modes"),
    settings_of("modes", see="both", symmetric=False),
    settings_of("cnn"),
    settings_of("cnn", symmetric=False),
    settings_of("cnn", see="both", size=70, frames=2),
    settings_of("cnn", frames=1),
    settings_of("nature", see="both"),
    settings_of("nature", symmetric=False, frames=2),
]


def network_of(settings: TrainingSettings) -> tuple[Network, Any]:
    card, policy, perception = randomly_excited(settings)
    content = exporting._build(Path("eye.onnx"), card, policy, perception)
    return Network(PolicyFile(Path("eye.onnx"), content, card)), perception


@pytest.mark.parametrize(
    "settings",
    CASES,
    ids=lambda case: f"{case.camera.feature_extractor}-{case.see}-{case.ppo.symmetric}",
)
def test_outputs_of_the_file_are_those_of_the_policy(settings: TrainingSettings) -> None:
    network, perception = network_of(settings)  # raises where they differ
    assert network.frames.shape == settings.camera.stack.shape
    assert len(network.row) == len(perception.features)


def test_where_frames_are_missing_the_file_swims_as_the_policy_is_evaluated(tmp_path: Path) -> None:
    settings = settings_of("modes", environment=EnvironmentSettings(history=3))
    card, policy, perception = randomly_excited(settings)
    path, config = tmp_path / "eye.onnx", Config()
    exporting._write(path, card, policy, perception)
    pilot = Pilot(str(path), replace(config.limits, dwell=0.0))
    decide = DeterministicPolicy(policy, perception, card.amplitude)
    link = SimulatedLink(config, camera=Camera(DEFAULT, settings.camera.stack))
    seen = link.reset()
    blind = {12, 15, 16, 19, *range(22, 30)}
    for tick, angle in enumerate(random_angles(1, 40, card.amplitude).tolist()):
        stack = None if tick in blind else link.look()
        assert pilot.angle(seen, stack) == pytest.approx(decide(seen, stack), abs=1e-4)
        seen = link.step(angle).observation


@pytest.mark.parametrize("extractor", ["cnn", "nature"])
def test_a_mirrored_picture_gets_the_mirrored_action(extractor: str) -> None:
    settings = settings_of(extractor)
    # Without the axis of the fish: the picture is mirrored about the middle row
    if extractor == "cnn":
        settings = replace(settings, camera=replace(settings.camera, align=False))
    card, policy, perception = randomly_excited(settings)
    if perception.extractor and extractor == "cnn":  # make its mean picture symmetric
        mean = perception.extractor.constants["mean"]
        perception.extractor.constants["mean"] = 0.5 * (mean + mean[::-1])
    sight = exporting._make_sight(policy, perception)
    content = to_onnx(layers_of(policy), activation_of(policy), card, sight)
    network = Network(PolicyFile(Path("eye.onnx"), content, card))
    random = np.random.default_rng(2)
    network.row[:] = 0.3, -0.8, 1.5  # φ_c, the one before, and the side time
    actions = []
    for stack in random.integers(80, 120, (8, *network.frames.shape), np.uint8):
        network.frames[:] = stack
        action = network.run()
        network.frames[:] = stack[:, ::-1]
        network.row[:] *= -1.0
        assert network.run() == pytest.approx(-action, abs=1e-4)
        network.row[:] *= -1.0
        actions.append(action)
    assert all(abs(action - following) > 1e-4 for action, following in pairwise(actions))


def test_another_eye_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    card, policy, perception = randomly_excited(settings_of("cnn"))
    make_sight = exporting._make_sight

    def without_mean(*arguments: Any) -> Any:
        sight = make_sight(*arguments)
        constants = dict(sight.constants)
        constants["mean"] = 0.0 * constants["mean"]
        return sight._replace(constants=constants)

    monkeypatch.setattr(exporting, "_make_sight", without_mean)
    with pytest.raises(PolicyError, match="outputs of the file differ from those of the policy"):
        exporting._write(tmp_path / "eye.onnx", card, policy, perception)
    assert list(tmp_path.iterdir()) == []


def test_a_model_of_the_user_that_sees_pictures_is_refused(tmp_path: Path) -> None:
    settings, config = settings_of("modes"), Config()
    link = SimulatedLink(config, camera=Camera(DEFAULT, settings.camera.stack))
    env = SwimEnv(link, config, settings.seen, randomly_excited(settings)[2].extractor)
    with pytest.raises(PolicyError, match="sees pictures is not exported from Python; train it"):
        export_model(PPO("MlpPolicy", env, device="cpu"), tmp_path / "eye.onnx")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_exported_policy_swims_by_sight(tmp_path: Path, by_sight: Outcome) -> None:
    exported = export(by_sight.best, tmp_path / "eye.onnx")
    past = exported.card.provenance
    assert past.relative_thrust == pytest.approx(by_sight.best_evaluation.relative_thrust)
    assert file.read(exported.path).card.pictures == StackSettings()
    standings, _ = compare(Config(), [str(exported.path)], seconds=20.0, settle=5.0)
    assert standings[0].relative_thrust == pytest.approx(past.relative_thrust, abs=0.05)


@pytest.mark.slow
def test_the_verb_prints_how_a_policy_by_sight_swims(tmp_path: Path, by_sight: Outcome) -> None:
    path = tmp_path / "eye.onnx"
    words = ["learn", "export", str(by_sight.folder), "--to", str(path)]
    result = CliRunner().invoke(fishctl, words)
    assert result.exit_code == 0, result.output
    assert result.output.endswith(f"it sees pictures; to let it swim: fishctl agent {path}\n")
