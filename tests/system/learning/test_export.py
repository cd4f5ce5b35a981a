from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from gymnasium import wrappers
from msgspec.structs import replace
from rigs.harness import Rig, observe
from rigs.swimming import NOISY, brief_job
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecNormalize

from fishd.cli.main import fishctl
from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.controllers.policy.card import Layout
from fishd.controllers.policy.file import read
from fishd.core.errors import PolicyError
from fishd.learning.export import export, export_model
from fishd.learning.ppo import DeterministicPolicy
from fishd.learning.run_folder import checkpoints
from fishd.learning.run_folder.checkpoints import CheckpointError
from fishd.learning.settings import PpoSettings
from fishd.learning.train.jobs import Outcome
from fishd.learning.train.training import train


@pytest.fixture(scope="module")
def stalled(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """A run that has learned nothing."""
    timid = PpoSettings(n_steps=64, n_epochs=1, learning_rate=1e-9, final_learning_rate=1e-9)
    return train(brief_job(tmp_path_factory.mktemp("is_stalled") / "run", ppo=timid, steps=64))


def test_outputs_of_the_file_are_those_of_the_policy(tmp_path: Path, by_force: Outcome) -> None:
    assert by_force.best
    exported = export(by_force.best, tmp_path / "policy.onnx")
    chosen = {"policy": str(exported.path)}
    controller = registry.create("ppo", chosen, Limits(0.42, 0.05, dwell=0.0))
    policy, perception = checkpoints.load_policy(by_force.best)
    decide = DeterministicPolicy(policy, perception, 0.42)
    draw = np.random.default_rng(1)
    for _ in range(200):
        fy, rate, velocity, angle = draw.normal(0.0, (0.4, 5.0, 0.03, 0.42)).tolist()
        seen = replace(observe(angle, velocity), fy=fy, fy_rate=rate)
        assert controller.update(seen) == pytest.approx(decide(seen), abs=1e-5)


def test_an_exported_policy_swims_in_the_robots_loop(tmp_path: Path, by_force: Outcome) -> None:
    assert by_force.best
    exported = export(by_force.best, tmp_path / "policy.onnx")
    rig = Rig(*NOISY)
    rig.start("ppo", policy=str(exported.path))
    rig.run_for(5.0)
    thrust = float(np.mean([tick.fx for tick in rig.run_for(10.0)]))
    assert rig.mode == "running"
    assert thrust == pytest.approx(exported.evaluation.thrust, rel=0.05)


def test_the_card_contains_the_evaluation_and_the_note(tmp_path: Path, by_force: Outcome) -> None:
    assert by_force.best
    assert by_force.best_evaluation
    past = export(by_force.best, tmp_path / "p.onnx", note="for the small tail").card.provenance
    assert past.note == "for the small tail"
    assert past.relative_thrust == pytest.approx(by_force.best_evaluation.relative_thrust)
    assert past.frequency == pytest.approx(by_force.best_evaluation.frequency)


def test_a_policy_that_stalls_is_refused_without_a_file(tmp_path: Path, stalled: Outcome) -> None:
    assert stalled.checkpoint
    target = tmp_path / "policy.onnx"
    with pytest.raises(PolicyError, match=r"this policy stalls .* nevertheless with --force"):
        export(stalled.checkpoint, target)
    assert list(tmp_path.iterdir()) == []
    assert export(stalled.checkpoint, target, force=True).evaluation.is_stalled
    assert target.exists()


def test_a_file_with_other_outputs_is_not_written(
    tmp_path: Path, by_force: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fishd.learning import export as exporting

    to_onnx = exporting.to_onnx
    monkeypatch.setattr(  # relu where the policy has tanh, as by a fault of the runtime
        exporting, "to_onnx", lambda layers, _, card, sight: to_onnx(layers, "relu", card, sight)
    )
    assert by_force.best
    with pytest.raises(PolicyError, match=r"differ .* wrongly: install another one"):
        export(by_force.best, tmp_path / "policy.onnx")
    assert list(tmp_path.iterdir()) == []


def test_a_broken_checkpoint_is_one_line(tmp_path: Path, by_force: Outcome) -> None:
    broken = tmp_path / "step-000064"
    broken.mkdir()
    (broken / "model.zip").write_bytes(b"PK")
    with pytest.raises(CheckpointError, match=r"card\.json: no such file"):
        export(broken, tmp_path / "p.onnx")
    assert by_force.best
    for name in ("card.json", "state.json"):
        (broken / name).write_bytes((by_force.best / name).read_bytes())
    with pytest.raises(CheckpointError, match=r"model\.zip: cannot be read: "):
        export(broken, tmp_path / "p.onnx")


def test_the_verb_takes_the_best_of_a_run_or_a_checkpoint(
    tmp_path: Path, by_force: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert by_force.best
    assert by_force.checkpoint

    def run_export(*arguments: str) -> str:
        result = CliRunner().invoke(fishctl, ["learn", "export", *arguments])
        assert result.exit_code == 0, result.output
        return result.output

    output = run_export(str(by_force.folder))
    assert output.startswith("run.onnx: ")
    assert f"from {by_force.best}" in output
    assert "it swims with" in output
    assert "fishctl set-controller ppo --policy run.onnx" in output
    assert f"from {by_force.checkpoint}" in run_export(str(by_force.folder), "--newest", "--force")
    assert f"from {by_force.checkpoint}" in run_export(str(by_force.checkpoint), "--to", "a/b.onnx")
    assert (tmp_path / "a" / "b.onnx").exists()


def own_env(**options: Any) -> Any:
    return gymnasium.make("fishd/Swim-v0", overrides=("amplitude_limit=0.3",), **options)


@pytest.mark.parametrize("kind", [PPO, A2C])
def test_a_model_of_the_user_becomes_a_policy_file(tmp_path: Path, kind: Any) -> None:
    model = kind("MlpPolicy", own_env(), n_steps=64, seed=4, device="cpu")
    model.learn(64)
    with pytest.warns(UserWarning, match="this policy stalls") as warned:
        path = export_model(model, str(tmp_path / "own.onnx"), note="tried on a whim")
    assert str(warned[0].message).startswith(f"{path}: this policy stalls when it swims without ")
    assert str(warned[0].message).endswith(
        "; it learned from 1 × 64 steps: more updates help, from more steps or a smaller n_steps"
    )
    controller = registry.create("ppo", {"policy": str(path)}, Limits(amplitude=0.3, tick=0.05))
    card = read(path).card
    env = model.get_env()
    assert env
    env.reset()
    seen = env.envs[0].unwrapped.latest
    action, _ = model.predict(Layout(card.observation).vector(seen), deterministic=True)
    assert controller.update(seen) == pytest.approx(0.3 * float(action[0]), abs=1e-5)
    past = card.provenance
    assert (past.algorithm, past.steps, past.seed) == (kind.__name__, 64, 4)
    assert past.note == "tried on a whim"
    assert set(past.settings) == {"environment"}


def test_the_defaults_of_stable_baselines3_with_shorter_rollouts_learn_to_swim(
    tmp_path: Path,
) -> None:
    torch.set_num_threads(1)
    model = PPO("MlpPolicy", "fishd/Swim-v0", n_steps=256, seed=0, device="cpu")
    model.learn(2048)
    past = read(export_model(model, tmp_path / "own.onnx")).card.provenance
    assert past.relative_thrust is not None
    assert past.relative_thrust > 0.7


def test_wrappers_that_change_nothing_that_the_policy_sees_or_does_are_permitted(
    tmp_path: Path,
) -> None:
    monitor = Monitor(wrappers.TimeLimit(own_env(), 100))
    env = wrappers.TransformReward(monitor, lambda r: 2.0 * r)
    rewards = VecNormalize(DummyVecEnv([lambda: env]), norm_obs=False)
    model = PPO("MlpPolicy", VecCheckNan(rewards), n_steps=64, device="cpu")
    model.learn(64)
    before = monitor.total_steps
    with pytest.warns(UserWarning, match="this policy stalls"):
        path = export_model(model, tmp_path / "own.onnx")
    assert read(path).card.provenance.steps == 64
    assert monitor.total_steps == before, "its fish may be a real one"


class Turned(gymnasium.RewardWrapper):
    """Wrapper of rewards that changes actions, too."""

    def reward(self, reward: Any) -> Any:
        return reward

    def step(self, action: Any) -> Any:
        return super().step(-action)


BOX = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
INPUTS = gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float32)
CHANGES: dict[str, Any] = {
    "TransformAction": lambda env: wrappers.TransformAction(env, lambda a: -a, BOX),
    "DelayObservation": lambda env: wrappers.DelayObservation(env, 2),
    "TransformObservation": lambda env: wrappers.TransformObservation(
        env, lambda observation: 10.0 * observation, INPUTS
    ),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "StickyAction": lambda env: wrappers.StickyAction(env, 0.5),
    "RescaleAction": lambda env: wrappers.RescaleAction(env, np.float32([-2.0]), np.float32([2.0])),
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
    "Turned": Turned,
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_wrapper_that_a_policy_file_would_lack_is_refused_by_name(
    tmp_path: Path, name: str
) -> None:
    model = PPO("MlpPolicy", CHANGES[name](own_env()), n_steps=64, device="cpu")
    with pytest.raises(PolicyError, match=f"trained behind the wrapper {name}, which may change"):
        export_model(model, tmp_path / "a.onnx")
    assert not list(tmp_path.iterdir())


class OwnExtractor(FlattenExtractor):
    """Extractor of features that is not that of stable-baselines3."""


def own_ppo(**policy: Any) -> PPO:
    return PPO("MlpPolicy", own_env(), n_steps=64, device="cpu", policy_kwargs=policy)


def with_norm() -> PPO:
    model = own_ppo()
    net = model.policy.mlp_extractor.policy_net
    net.append(torch.nn.LayerNorm(net[-2].out_features))
    return model


def in_double_precision() -> PPO:
    model = own_ppo()
    model.policy.double()
    return model


def with_hook() -> PPO:
    model = own_ppo()
    model.policy.action_net.register_forward_hook(lambda _net, _inputs, output: output + 0.1)
    return model


class RecurrentActorCriticPolicy(ActorCriticPolicy):
    """A policy with the name of that of sb3-contrib's RecurrentPPO."""


def squashed() -> PPO:
    options = {"squash_output": True}
    return PPO("MlpPolicy", own_env(), use_sde=True, policy_kwargs=options, device="cpu")


REFUSED: dict[str, tuple[Any, str]] = {
    "elsewhere": (
        lambda: PPO("MlpPolicy", "Pendulum-v1", device="cpu"),
        "PendulumEnv, is not a SwimEnv of this process",
    ),
    "normalised": (
        lambda: PPO("MlpPolicy", VecNormalize(DummyVecEnv([own_env])), device="cpu"),
        "behind the wrapper VecNormalize, .* without that one or with norm_obs=False; the",
    ),
    "SAC": (lambda: SAC("MlpPolicy", own_env(), device="cpu"), "of PPO or A2C, not SACPolicy"),
    "ELU": (lambda: own_ppo(activation_fn=torch.nn.ELU), "activation ELU cannot be exported"),
    "extractor": (
        lambda: own_ppo(features_extractor_class=OwnExtractor),
        "without the extractor of features OwnExtractor",
    ),
    "norm": (with_norm, "with linear layers and tanh, not with LayerNorm"),
    "double": (in_double_precision, r"is in float64: call model\.policy\.float\(\)"),
    "hook": (with_hook, "by up to 0.1 of Φ: the model does more than its layers, which a policy"),
    "recurrent": (
        lambda: PPO(RecurrentActorCriticPolicy, own_env(), device="cpu"),
        "the MlpPolicy of PPO or A2C, not RecurrentActorCriticPolicy",
    ),
    "squashed": (squashed, "without squash_output"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_model_that_a_policy_file_cannot_represent_is_refused(tmp_path: Path, name: str) -> None:
    make, message = REFUSED[name]
    with pytest.raises(PolicyError, match=message):
        export_model(make(), tmp_path / "a.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere", "no such folder; the run folder of a training is needed"),
        ("model.zip", "not a folder; the run folder of a training is needed"),
        ("several", "holds several trainings, seed-0 to seed-10; name one of them"),
        ("empty", "it contains no checkpoint"),
    ],
)
def test_a_path_that_is_not_a_run_is_refused(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "model.zip").write_bytes(b"PK")
    (tmp_path / "empty").mkdir()
    for seed in (0, 2, 10):
        (tmp_path / "several" / f"seed-{seed}").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=f"{name}:? {message}"):
        checkpoints.find(tmp_path / name)


def test_a_file_with_another_suffix_is_not_written(tmp_path: Path, by_force: Outcome) -> None:
    words = ["learn", "export", str(by_force.best), "--to", str(tmp_path / "mine.pt")]
    refused = CliRunner().invoke(fishctl, words)
    assert isinstance(refused.exception, PolicyError)
    assert str(refused.exception).endswith("the name of a policy file must end in .onnx")
    assert not list(tmp_path.iterdir())


def test_the_command_overwrites_a_file_only_with_force(tmp_path: Path, by_force: Outcome) -> None:
    target = tmp_path / "mine.onnx"
    target.write_text("precious")
    words = ["learn", "export", str(by_force.best), "--to", str(target)]
    refused = CliRunner().invoke(fishctl, words)
    assert isinstance(refused.exception, PolicyError)
    refusal = "exists already; --force overwrites it, --to names another"
    assert str(refused.exception) == f"{target}: {refusal}"
    assert target.read_text() == "precious"
    assert CliRunner().invoke(fishctl, [*words, "--force"]).exit_code == 0
    assert read(target).card.amplitude == 0.42
