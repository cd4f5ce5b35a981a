import functools
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from gymnasium import spaces, wrappers
from msgspec.structs import replace
from rigs.harness import Rig
from rigs.policy_files import vector
from rigs.swimming import NOISY, brief_job
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecCheckNan, VecNormalize

from fishd.cli.main import fishctl
from fishd.config import load
from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.controllers.policy.file import read
from fishd.controllers.policy.runtime import Network
from fishd.core.errors import PolicyError
from fishd.learning.env.environment import SwimEnv
from fishd.learning.export import export, export_model
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.run_folder import checkpoints
from fishd.learning.run_folder.checkpoints import CheckpointError
from fishd.learning.settings import EnvironmentSettings, PpoSettings
from fishd.learning.train.jobs import Outcome
from fishd.learning.train.training import train


@pytest.fixture(scope="module")
def stalled(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """A run that has learned nothing."""
    timid = PpoSettings(n_steps=64, n_epochs=1, learning_rate=1e-9, final_learning_rate=1e-9)
    return train(brief_job(tmp_path_factory.mktemp("is_stalled") / "run", ppo=timid, steps=64))


def test_an_exported_policy_swims_in_the_robots_loop(tmp_path: Path, by_force: Outcome) -> None:
    exported = export(by_force.best, tmp_path / "policy.onnx")
    rig = Rig(*NOISY)
    rig.start("ppo", policy=str(exported.path))
    rig.run_for(5.0)
    thrust = float(np.mean([tick.fx for tick in rig.run_for(10.0)]))
    assert rig.mode == "running"
    assert thrust == pytest.approx(exported.evaluation.thrust, rel=0.05)


def test_the_card_contains_the_evaluation_and_the_note(tmp_path: Path, by_force: Outcome) -> None:
    past = export(by_force.best, tmp_path / "p.onnx", note="for the small tail").card.provenance
    assert past.note == "for the small tail"
    assert past.relative_thrust == pytest.approx(by_force.best_evaluation.relative_thrust)
    assert past.frequency == pytest.approx(by_force.best_evaluation.frequency)


def test_a_policy_that_stalls_is_refused_without_a_file(tmp_path: Path, stalled: Outcome) -> None:
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
    with pytest.raises(PolicyError, match=r"differ .* wrongly: install another one"):
        export(by_force.best, tmp_path / "policy.onnx")
    assert list(tmp_path.iterdir()) == []


def test_a_broken_checkpoint_is_one_line(tmp_path: Path, by_force: Outcome) -> None:
    broken = tmp_path / "step-000064"
    broken.mkdir()
    (broken / "model.zip").write_bytes(b"PK")
    with pytest.raises(CheckpointError, match=r"card\.json: no such file"):
        export(broken, tmp_path / "p.onnx")
    for name in ("card.json", "state.json"):
        (broken / name).write_bytes((by_force.best / name).read_bytes())
    with pytest.raises(CheckpointError, match=r"model\.zip: cannot be read: "):
        export(broken, tmp_path / "p.onnx")


def test_the_verb_takes_the_best_of_a_run_or_a_checkpoint(
    tmp_path: Path, by_force: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

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
        "; it learned from 64 steps, in rollouts of 64 × 1: more updates help, from more steps or "
        "a smaller n_steps"
    )
    controller = registry.create("ppo", {"policy": str(path)}, Limits(amplitude=0.3, tick=0.05))
    card = read(path).card
    env = model.get_env()
    env.reset()
    seen = env.envs[0].unwrapped.latest
    action, _ = model.predict(vector(card.observation, seen), deterministic=True)
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


BOX = spaces.Box(-1.0, 1.0, (1,), np.float32)
CHANGES: dict[str, Any] = {
    "TransformAction": lambda env: wrappers.TransformAction(env, lambda a: -a, BOX),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "FrameStackObservation": lambda env: wrappers.FrameStackObservation(env, 3),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_wrapper_that_a_policy_file_would_lack_is_refused_by_name(
    tmp_path: Path, name: str
) -> None:
    model = PPO("MlpPolicy", CHANGES[name](own_env()), n_steps=64, device="cpu")
    with pytest.raises(
        PolicyError, match=f"the wrapper of this model is {name}, which may do more"
    ):
        export_model(model, tmp_path / "a.onnx")
    assert not list(tmp_path.iterdir())


class OwnExtractor(FlattenExtractor):
    """Extractor of features that is not that of stable-baselines3."""


def own_ppo(**policy: Any) -> PPO:
    return PPO("MlpPolicy", own_env(), n_steps=64, device="cpu", policy_kwargs=policy)


def changed(change: Callable[[Any], object], **policy: Any) -> PPO:
    """Return a model after a change of its policy."""
    model = own_ppo(**policy)
    change(model.policy)
    return model


class RecurrentActorCriticPolicy(ActorCriticPolicy):
    """A policy with the name of that of sb3-contrib's RecurrentPPO."""


def in_envs(envs: Any) -> PPO:
    model = own_ppo()
    model.env = envs
    return model


def squashed() -> PPO:
    options = {"squash_output": True}
    return PPO("MlpPolicy", own_env(), use_sde=True, policy_kwargs=options, device="cpu")


class Mirrored(PPO):
    """PPO whose actions are mirrored when it is used."""

    def predict(self, *given: Any, **options: Any) -> Any:
        action, state = super().predict(*given, **options)
        return -action, state


class MirroredEnvs(DummyVecEnv):
    """Environments that receive the mirrored actions."""

    def step_async(self, actions: Any) -> None:
        super().step_async(-actions)


class MirroredFish(SwimEnv):
    """An environment that swims to the other side."""

    def step(self, action: Any) -> Any:
        return super().step(-action)


def fish(kind: type[SwimEnv] = SwimEnv, *overrides: str, **settings: Any) -> SwimEnv:
    config = load(None, overrides)
    return kind(SimulatedLink(config), config, EnvironmentSettings(**settings))


def several(*envs: SwimEnv) -> PPO:
    return PPO("MlpPolicy", DummyVecEnv([lambda env=env: env for env in envs]), device="cpu")


def features_changed() -> SwimEnv:
    env = fish()
    env.features = tuple(replace(feature, scale=2.0) for feature in env.features)
    return env


class TwiceTheMean(DiagGaussianDistribution):
    """A distribution that is not what the layers compute."""

    def mode(self) -> torch.Tensor:
        return 2.0 * super().mode()


LEAKY = functools.partial(torch.nn.LeakyReLU, 0.3)
REFUSED: dict[str, tuple[Any, str]] = {
    "elsewhere": (
        lambda: PPO("MlpPolicy", "Pendulum-v1", device="cpu"),
        r"the environment of this model is PendulumEnv, .*: load the model with env=gymnasium\.",
    ),
    "normalised": (
        lambda: PPO("MlpPolicy", VecNormalize(DummyVecEnv([own_env])), device="cpu"),
        "wrapper of this model is VecNormalize, .* without that wrapper or with norm_obs=False; th",
    ),
    "SAC": (lambda: SAC("MlpPolicy", own_env(), device="cpu"), "algorithm of this model is SAC, "),
    "a text": (
        lambda: "mine.zip",
        r"must be a PPO or A2C of stable-baselines3, not 'mine\.zip': load one with PPO\.load",
    ),
    "nothing": (lambda: None, "must be a PPO or A2C of stable-baselines3, not None: load one with"),
    "bare": (
        lambda: PPO("MlpPolicy", own_env(), _init_setup_model=False),
        r"policy of this model is missing: train one with PPO\('MlpPolicy', env\)",
    ),
    "ELU": (
        lambda: own_ppo(activation_fn=torch.nn.ELU),
        "hidden layer of this model is ELU, .* th",
    ),
    "partial": (lambda: own_ppo(activation_fn=LEAKY), "hidden layer of this model is LeakyReLU, "),
    "extractor": (
        lambda: own_ppo(features_extractor_class=OwnExtractor),
        "extractor of features of this model is OwnExtractor, ",
    ),
    "norm": (
        lambda: changed(lambda p: p.mlp_extractor.policy_net.append(torch.nn.LayerNorm(64))),
        "hidden layer of this model is LayerNorm, .* the same Tanh or ReLU",
    ),
    "double": (
        lambda: changed(lambda p: p.double()),
        r"is in float64: call model\.policy\.float\(\)",
    ),
    "hook": (
        lambda: changed(lambda p: p.action_net.register_forward_hook(lambda *io: io[2] + 0.1)),
        "differ from those of the policy .* the model does more than its layers",
    ),
    "recurrent": (
        lambda: PPO(RecurrentActorCriticPolicy, own_env(), device="cpu"),
        "policy of this model is RecurrentActorCriticPolicy, ",
    ),
    "squashed": (squashed, "a policy file has no squash_output: train one without it"),
    "more than layers": (
        lambda: changed(lambda p: setattr(p, "action_dist", TwiceTheMean(1))),
        "differ from those of the policy by up to .* the model does more than its layers",
    ),
    "too large": (
        lambda: own_ppo(net_arch={"pi": [2100, 2100], "vf": [8]}, ortho_init=False),
        "weights of this policy take 17 MB, and 15 are the most; train one with fewer units in its",
    ),
    "not a number": (
        lambda: changed(lambda p: p.log_std.data.fill_(np.nan)),
        "its log_std is not finite: the training diverged; ",
    ),
    "overflow": (
        lambda: changed(
            lambda p: [part.data.mul_(1e30) for part in p.parameters()],
            activation_fn=torch.nn.ReLU,
        ),
        "this model computes no action: .*; export an earlier checkpoint",
    ),
    "other bounds": (
        lambda: changed(lambda p: setattr(p, "action_space", spaces.Box(-0.5, 0.5, (1,)))),
        r"actions of this model are Box\(-0\.5, .*, those of a SwimEnv Box\(-1\.0, ",
    ),
    "Mirrored": (
        lambda: Mirrored("MlpPolicy", own_env(), device="cpu"),
        "algorithm of this model is Mirrored, .* itself with PPO.load",
    ),
    "MirroredEnvs": (
        lambda: PPO("MlpPolicy", MirroredEnvs([own_env]), device="cpu"),
        "vectorised environment of this model is MirroredEnvs, ",
    ),
    "MirroredFish": (
        lambda: PPO("MlpPolicy", fish(MirroredFish), device="cpu"),
        "the environment of this model is MirroredFish, ",
    ),
    "own forward": (
        lambda: changed(lambda p: setattr(p.action_net, "forward", print)),
        "this model computes no action: ",
    ),
    "another tick": (
        lambda: several(fish(), fish(SwimEnv, "tick=0.1")),
        r"environment 1 of this model has not the configuration with which .* equal environments",
    ),
    "other settings": (
        lambda: several(fish(), fish(episode=100)),
        r"environment 1 of this model has not the settings with ",
    ),
    "another class": (
        lambda: several(fish(), fish(MirroredFish)),
        "the environment of this model is MirroredFish, ",
    ),
    "changed features": (
        lambda: several(features_changed()),
        "environment 0 of this model has not the features with ",
    ),
    "no last activation": (
        lambda: changed(lambda p: p.mlp_extractor.policy_net.append(torch.nn.Linear(64, 64))),
        "hidden layer of this model is missing: train one with linear layers, each followed by",
    ),
    "other processes": (
        lambda: in_envs(SubprocVecEnv.__new__(SubprocVecEnv)),
        r"SubprocVecEnv, .*Swim-v0'\), .* training, since environments in other processes cannot",
    ),
    "no environment": (
        lambda: in_envs(None),
        r"vectorised environment of this model is missing: load the model with env=gymnasium\.",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_model_that_a_policy_file_cannot_represent_is_refused(tmp_path: Path, name: str) -> None:
    make, message = REFUSED[name]
    with pytest.raises(PolicyError, match=message) as refused:
        export_model(make(), tmp_path / "a.onnx")
    assert str(refused.value).startswith(f"{tmp_path / 'a.onnx'}: ")
    assert str(refused.value).count("a.onnx") == 1
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 400
    assert not list(tmp_path.iterdir())


def loaded_without_steps() -> PPO:
    stored = io.BytesIO()
    own_ppo().save(stored)
    return PPO.load(stored, env=own_env(), custom_objects={"n_steps": 0})


EXPORTED: dict[str, Any] = {
    "last layer without bias": lambda: changed(
        lambda p: setattr(p, "action_net", torch.nn.Linear(64, 1, bias=False))
    ),
    "large actions without hidden layers": lambda: changed(
        lambda p: p.action_net.weight.data.mul_(100.0), net_arch=[]
    ),
    "activation made by a function": lambda: own_ppo(
        activation_fn=functools.partial(torch.nn.ReLU)
    ),
    "loaded without steps": loaded_without_steps,
    "several fish with their own noise": lambda: several(
        fish(), fish(SwimEnv, "simulation.seed=5")
    ),
    "history": lambda: several(fish(history=3)),
}


@pytest.mark.filterwarnings("ignore:.*this policy stalls")
@pytest.mark.parametrize("name", EXPORTED)
def test_the_file_of_an_unusual_model_has_the_outputs_of_its_policy(
    tmp_path: Path, name: str
) -> None:
    model = EXPORTED[name]()
    network = Network(read(export_model(model, tmp_path / "a.onnx")))
    for row in np.random.default_rng(3).normal(size=(20, len(network.row))).astype(np.float32):
        network.row[:] = row
        assert network.run() == pytest.approx(
            model.predict(row, deterministic=True)[0][0], abs=1e-5
        )


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
