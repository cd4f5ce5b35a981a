"""Export of a checkpoint, or a model of stable-baselines3, to a file for the controller `ppo`."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium
import msgspec
import numpy as np
import torch
from gymnasium import wrappers
from msgspec import Struct
from msgspec.structs import replace
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)
from torch.nn import Linear, ReLU, Sequential, Tanh

from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config, adopt
from fishd.controllers.policy.card import Card
from fishd.controllers.policy.file import FRAMES, INPUT, PolicyFile
from fishd.controllers.policy.network import Sight, to_onnx
from fishd.controllers.policy.runtime import Network
from fishd.core.camera_frames import Stack
from fishd.core.errors import FishdError, PolicyError
from fishd.core.files import os_errors, write_atomically
from fishd.core.text import describe_error, line, quoted
from fishd.learning.env.environment import SwimEnv, features
from fishd.learning.env.evaluation import Evaluation, evaluate_in_simulation
from fishd.learning.env.perception import Perception
from fishd.learning.extractors import random_angles
from fishd.learning.links.simulated_link import Camera, SimulatedLink
from fishd.learning.picture_networks import PictureExtractor, network_nodes
from fishd.learning.ppo import DeterministicPolicy, MeanAction, activation_of, layers_of
from fishd.learning.run_folder import checkpoints, runs
from fishd.learning.run_folder.runs import make_card
from fishd.learning.settings import (
    EvaluationSettings,
    TrainingSettings,
    from_plain,
)

TOLERANCE = 1e-4
"""Largest difference between the outputs of the file and of the trained policy, as a share of Φ:
pixels and large weights are summed, in an order that differs between libraries."""
NEUTRAL_WRAPPERS: tuple[type[Any], ...] = (
    gymnasium.RewardWrapper,
    Monitor,
    VecCheckNan,
    VecMonitor,
    VecVideoRecorder,
    wrappers.Autoreset,
    wrappers.HumanRendering,
    wrappers.NormalizeReward,
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.RecordEpisodeStatistics,
    wrappers.RecordVideo,
    wrappers.RenderCollection,
    wrappers.TimeLimit,
)
"""Wrappers of environments that change neither observations nor actions, with their subclasses."""
_LOAD_WITH_FISH = (
    "load the model with env=gymnasium.make('fishd/Swim-v0'), with the config, settings and "
    "overrides of its training"
)
_ABOUT_1 = "; the observations of a SwimEnv are about 1 already"
_MORE_REMEDIES: dict[type[Any], str] = {
    wrappers.NormalizeObservation: _ABOUT_1,
    VecNormalize: f" or with norm_obs=False{_ABOUT_1}",
    SubprocVecEnv: ", since environments in other processes cannot be checked",
}
"""Additions to the remedy for a part of one of these types."""
_PROBE_INPUTS = 1000
_PROBE_STACKS = 100
"""Number of stacks of noise, and of stacks of a moving tail."""


class Exported(Struct, frozen=True):
    """The result of an export."""

    path: Path
    checkpoint: Path
    card: Card
    evaluation: Evaluation
    size: int
    """Size of the file [bytes]."""


def export(checkpoint: Path, target: Path, *, force: bool = False, note: str = "") -> Exported:
    """Evaluate the policy of a checkpoint, and write it to `target`.

    force: write the file even where the policy stalls
    note: text for the user, stored in the file

    Raises `CheckpointError`, and `PolicyError` where the policy stalls or the outputs of the
    file would differ from those of the policy.
    """
    torch.set_num_threads(1)  # for single pictures, more threads are slower
    card = checkpoints.read_card(checkpoint)
    policy, perception = checkpoints.load_policy(checkpoint)
    evaluation = _evaluate(checkpoint, card, policy, perception)
    if evaluation.is_stalled and not force:
        raise PolicyError(
            f"{checkpoint}: {_format_stall(evaluation)}; train longer, choose another checkpoint, "
            "or export it nevertheless with --force"
        )
    card = _complete_card(card, evaluation, note)
    size = _write(target, card, policy, perception)
    return Exported(target, checkpoint, card, evaluation, size)


def export_model(model: BaseAlgorithm, target: str | Path, note: str = "") -> Path:
    """Write the policy of a model of stable-baselines3 that was trained on a `SwimEnv`.

    model: PPO or A2C with an `MlpPolicy` of tanh or relu; its environments are equal, of this
        process, and have no wrappers but `NEUTRAL_WRAPPERS`
    note: text for the user, stored in the file

    Warns of a policy that stalls. Raises `PolicyError` for any other model or subclass, and where
    the outputs of the file would differ from those of the policy.
    """
    path = Path(target)
    try:
        env, policy = _check_model(model)
        seen = TrainingSettings(environment=env.settings)
        card = make_card(env.config, seen, env.features, "a SwimEnv", 0, None, note)
        past = replace(
            card.provenance,
            algorithm=type(model).__name__,
            steps=model.num_timesteps,
            seed=model.seed or 0,
            settings={"environment": msgspec.to_builtins(env.settings)},
        )
        card = replace(card, provenance=past)
    except PolicyError as problem:
        raise PolicyError(f"{path}: {problem}") from None
    _build(path, card, policy, env.perception)  # raises before the swim
    decide = DeterministicPolicy(policy, env.perception, card.amplitude)
    evaluation = evaluate_in_simulation(env.config, decide, EvaluationSettings())
    _write(path, _complete_card(card, evaluation), policy, env.perception)
    if evaluation.is_stalled:
        rollout = cast(OnPolicyAlgorithm, model).n_steps
        warnings.warn(
            f"{path}: {_format_stall(evaluation)}; it learned from {model.num_timesteps} steps, in "
            f"rollouts of {rollout} × {model.n_envs}: more updates help, from more steps or a "
            "smaller n_steps",
            stacklevel=2,
        )
    return path


def _format_stall(evaluation: Evaluation) -> str:
    """Return that a policy stalls, with its figures."""
    return (
        "this policy stalls when it swims without exploration: "
        f"{evaluation.frequency:.2f} Hz, |φ_c| {evaluation.fullness:.0%} of Φ"
    )


class _Part(NamedTuple):
    """A part of a model through which observations or actions pass."""

    role: str
    part: Any
    permitted: tuple[type[Any], ...]
    """Types that do nothing that a policy file lacks."""
    remedy: str


def _parts(model: Any) -> Iterator[_Part]:
    """Yield the parts of a model, from which the next one is reached after they are checked."""
    yield _Part("algorithm", model, (PPO, A2C), "load a model of PPO or A2C itself with PPO.load")
    policy: Any = getattr(model, "policy", None)
    yield _Part("policy", policy, (ActorCriticPolicy,), "train one with PPO('MlpPolicy', env)")
    remedy = "train one with the defaults of MlpPolicy, or other net_arch and activation_fn"
    for extractor in (policy.features_extractor, policy.pi_features_extractor):
        yield _Part("extractor of features", extractor, (FlattenExtractor,), remedy)
    yield _Part("hidden network", policy.mlp_extractor, (MlpExtractor,), remedy)
    layers = policy.mlp_extractor.policy_net
    yield _Part("hidden network", layers, (Sequential,), remedy)
    remedy = "train one with linear layers, each followed by the same Tanh or ReLU"
    activations: tuple[type[Any], ...] = (Tanh, ReLU)
    for number, layer in enumerate([*layers, *[None] * (len(layers) % 2)]):
        yield _Part("hidden layer", layer, activations if number % 2 else (Linear,), remedy)
        activations = (type(layer),) if number % 2 else activations
    yield _Part("last layer", policy.action_net, (Linear,), remedy)
    env = model.get_env()
    while isinstance(env, VecEnvWrapper):
        yield _wrapper(env)
        env = env.venv
    yield _Part("vectorised environment", env, (DummyVecEnv,), _LOAD_WITH_FISH)
    for layer in env.envs:
        while isinstance(layer, gymnasium.Wrapper):
            yield _wrapper(layer)
            layer = layer.env
        yield _Part("environment", layer, (SwimEnv,), _LOAD_WITH_FISH)
        yield _Part("perception", layer.perception, (Perception,), _LOAD_WITH_FISH)


def _wrapper(wrapper: Any) -> _Part:
    """Return the part of a wrapper, permitted if it changes neither observations nor actions."""
    is_neutral = (
        not wrapper.norm_obs
        if isinstance(wrapper, VecNormalize)
        else isinstance(wrapper, NEUTRAL_WRAPPERS)
    )
    permitted = (type(wrapper),) if is_neutral else ()
    return _Part("wrapper", wrapper, permitted, "train one without that wrapper")


def _check_model(model: Any) -> tuple[SwimEnv, ActorCriticPolicy]:
    """Return environment and policy of a model; raise `PolicyError` if they do more than a file."""
    if not isinstance(model, BaseAlgorithm):
        raise PolicyError(
            "the model of this policy must be a PPO or A2C of stable-baselines3, not "
            f"{quoted(repr(model))}: load one with PPO.load"
        )
    envs = []
    for role, part, permitted, remedy in _parts(model):
        name = "missing" if part is None else type(part).__name__
        if type(part) not in permitted:
            remedy += _MORE_REMEDIES.get(type(part), "")
            why = ", which may do more than a policy file, so that the file would swim otherwise"
            raise PolicyError(
                f"the {role} of this model is {name}{why if part is not None else ''}: {remedy}"
            )
        if type(part) is SwimEnv:
            envs.append(part)
    for number, env in enumerate(envs):
        _check_equal(envs[0], env, number)
    policy = cast(ActorCriticPolicy, model.policy)
    _check_numbers(policy)
    if policy.action_space != envs[0].action_space:
        raise PolicyError(
            f"the actions of this model are {policy.action_space}, those of a SwimEnv "
            f"{envs[0].action_space}: load it without custom_objects"
        )
    return envs[0], policy


def _check_equal(first: SwimEnv, env: SwimEnv, number: int) -> None:
    """Raise `PolicyError` if an environment is not equal to the first; noise may differ."""
    if env.extractor:
        raise PolicyError(
            "a model that sees pictures is not exported from Python; train it with 'fishctl learn "
            "ppo --see camera'"
        )
    noise = replace(env.config.simulation, seed=first.config.simulation.seed)
    for name, here, there in (
        ("configuration", first.config, replace(env.config, simulation=noise)),
        ("settings", first.settings, env.settings),
        ("features", features(first.config, first.settings), env.features),
    ):
        if here != there:
            raise PolicyError(
                f"environment {number} of this model has not the {name} with which environment 0 "
                "was made, and a policy file has only one: train one in equal environments"
            )


def _check_numbers(policy: ActorCriticPolicy) -> None:
    """Raise `PolicyError` for numbers that a policy file cannot have."""
    if policy.squash_output:
        raise PolicyError("a policy file has no squash_output: train one without it")
    for name, parameter in policy.named_parameters():
        if parameter.dtype is not torch.float32:
            kind = str(parameter.dtype).removeprefix("torch.")
            raise PolicyError(
                f"a policy file is in float32, this policy is in {kind}: call model.policy.float()"
            )
        if not bool(torch.isfinite(parameter).all()):
            raise PolicyError(
                f"its {name} is not finite: the training diverged; export an earlier checkpoint, "
                "or train one with a smaller learning_rate"
            )


def _build(target: Path, card: Card, policy: ActorCriticPolicy, perception: Perception) -> bytes:
    """Return the content of the file; raises `PolicyError` if its outputs are other ones."""
    try:
        sight = _make_sight(policy, perception)
        content = to_onnx(layers_of(policy), activation_of(policy), card, sight)
    except PolicyError as problem:
        raise PolicyError(f"{target}: {problem}") from None
    _verify(PolicyFile(target, content, card), policy, perception)
    return content


def _write(target: Path, card: Card, policy: ActorCriticPolicy, perception: Perception) -> int:
    """Write the file atomically; return its size [bytes]. Raises `PolicyError`."""
    content = _build(target, card, policy, perception)
    if not target.name or (target.exists() and not target.is_file()):
        raise PolicyError(f"{target}: exists already, and is not a regular file")
    with os_errors(PolicyError, f"{target}: cannot be written"):
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, content)
    return len(content)


def _make_sight(policy: ActorCriticPolicy, perception: Perception) -> Sight | None:
    """Return the graph from frames to the inputs of the first layer; None without frames."""
    from onnx import TensorProto, helper

    feature_extractor = perception.extractor
    if feature_extractor is None:
        return None
    nodes = [helper.make_node("Cast", [FRAMES], ["grey"], to=TensorProto.FLOAT)]
    more, constants = feature_extractor.nodes("grey", "eye")
    nodes += more
    parts, width = ["eye"], feature_extractor.outputs
    others = [INPUT] if perception.features else []
    extractor = policy.features_extractor
    mirrored = isinstance(extractor, PictureExtractor) and extractor.mirrored
    if isinstance(extractor, PictureExtractor):
        parts, picture = ["features"], "eye"
        width = extractor.single - perception.numbers
        if mirrored:
            ends = {"begin": [-1], "end": [np.iinfo(np.int64).min], "rows": [2], "back": [-1]}
            constants |= {f"flip_{name}": np.array(value) for name, value in ends.items()}
            nodes.append(
                helper.make_node("Slice", ["eye", *(f"flip_{name}" for name in ends)], ["mirror"])
            )
            nodes.append(helper.make_node("Concat", ["eye", "mirror"], ["pair"], axis=0))
            picture = "pair"
        more, weights = network_nodes(extractor.network, picture, "features")
        nodes += more
        constants |= weights
    if others and mirrored:
        nodes.append(helper.make_node("Neg", [INPUT], ["negated"]))
        nodes.append(helper.make_node("Concat", [INPUT, "negated"], ["numbers"], axis=0))
        others = ["numbers"]
    nodes.append(helper.make_node("Concat", [*parts, *others], ["given"], axis=1))
    return Sight(nodes, constants, "given", width + perception.numbers, mirrored)


def _evaluate(
    checkpoint: Path, card: Card, policy: ActorCriticPolicy, perception: Perception
) -> Evaluation:
    """Return the evaluation of the policy on the robot, else on its simulated fish."""
    state = checkpoints.read_state(checkpoint)
    if state.on == "live":
        for evaluation in (state.best, state.latest):
            if evaluation and evaluation.policy == state.steps:
                return evaluation
    try:  # with the imperfections of its rig, where the run folder still exists
        config, _ = runs.read(checkpoint.parent)
    except FishdError:
        config = Config()
    plant = adopt({"plant": card.provenance.plant}).plant
    config = replace(config, tick=card.tick, amplitude_limit=card.amplitude, plant=plant)
    decide = DeterministicPolicy(policy, perception, card.amplitude)
    settings = from_plain(card.provenance.settings)
    camera = _camera(checkpoint.parent, card)
    return evaluate_in_simulation(config, decide, settings.evaluation, camera)


def _camera(run: Path, card: Card) -> Camera | None:
    """Return the camera of a run, else the default; None for a policy that sees no pictures."""
    if card.pictures is None:
        return None
    try:
        seen = runs.read_camera(run)
    except FishdError:
        seen = SimulatedCameraSettings()
    return Camera(seen, card.pictures)


def _complete_card(card: Card, evaluation: Evaluation, note: str = "") -> Card:
    """Return the card with the figures of an evaluation, and the note."""
    past = replace(
        card.provenance,
        relative_thrust=evaluation.relative_thrust,
        frequency=evaluation.frequency,
        note="; ".join(part for part in (card.provenance.note, note) if part),
    )
    return replace(card, provenance=past)


def _verify(file: PolicyFile, policy: ActorCriticPolicy, perception: Perception) -> None:
    """Compare the file, run as on the robot, with the policy on random inputs.

    Raises `PolicyError`.
    """
    stacks = _probe_stacks(file.card)
    number = len(stacks) or _PROBE_INPUTS
    random = np.random.default_rng(0)
    rows = random.normal(0.0, 1.5, (number, file.card.numbers)).astype(np.float32)
    given = rows
    if perception.extractor:
        seen = np.array([perception.extractor.see(stack) for stack in stacks])
        given = np.concatenate((seen, rows), axis=1)
    try:
        expected = policy.predict(given, deterministic=True)[0][:, 0].astype(np.float64)
    except Exception as error:  # those of torch differ
        raise PolicyError(
            f"{file.path}: this model computes no action: {line(describe_error(error), 120)}; "
            "export an earlier checkpoint"
        ) from None
    network = Network(file)
    outputs = []
    for index, row in enumerate(rows):
        network.row[:] = row
        if stacks:
            network.frames[:] = stacks[index]
        outputs.append(network.run())
    worst = float(np.abs(np.array(outputs) - expected).max())
    if not worst <= TOLERANCE:
        layers = MeanAction(policy)
        computed = np.clip([layers(row) for row in given], -1.0, 1.0)
        cause = (
            "this version of onnxruntime computes its layers wrongly: install another one"
            if np.abs(computed - expected).max() <= TOLERANCE
            else "the model does more than its layers, which a policy file cannot have"
        )
        raise PolicyError(
            f"{file.path}: the outputs of the file differ from those of the policy by up to "
            f"{worst:.2g} of Φ: {cause}"
        )


def _probe_stacks(card: Card) -> list[Stack]:
    """Return stacks of noise, and of a simulated fish that moves at random, if any are seen."""
    if card.pictures is None:
        return []
    random = np.random.default_rng(1)
    noise = random.integers(0, 256, (_PROBE_STACKS, *card.pictures.shape), np.uint8)
    stacks = [tuple(stack) for stack in noise]
    config = replace(Config(), tick=card.tick, amplitude_limit=card.amplitude)
    link = SimulatedLink(config, camera=Camera(SimulatedCameraSettings(), card.pictures))
    link.reset()
    for angle in random_angles(0, _PROBE_STACKS, card.amplitude).tolist():
        link.step(angle)
        if (stack := link.look()) is not None:
            stacks.append(stack)
    return stacks
