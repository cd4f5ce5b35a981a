"""Export of a checkpoint, or a model of stable-baselines3, to a file for the controller `ppo`."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import gymnasium
import msgspec
import numpy as np
import torch
from gymnasium import wrappers
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)

from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config, adopt
from fishd.controllers.policy.card import Card
from fishd.controllers.policy.file import FRAMES, INPUT, PolicyFile
from fishd.controllers.policy.network import Sight, to_onnx
from fishd.controllers.policy.runtime import Network
from fishd.core.camera_frames import Stack
from fishd.core.errors import FishdError, PolicyError
from fishd.core.files import write_atomically
from fishd.lab.links.simulated_link import Camera, SimulatedLink
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Evaluation, evaluate_in_simulation
from fishd.learning.env.perception import Perception
from fishd.learning.extractors import random_angles
from fishd.learning.picture_networks import PictureExtractor, network_nodes
from fishd.learning.ppo import DeterministicPolicy, MeanAction, activation_of, layers_of
from fishd.learning.run_folder import checkpoints, runs
from fishd.learning.run_folder.runs import make_card
from fishd.learning.settings import EvaluationSettings, TrainingSettings, from_plain

TOLERANCE = 1e-4
"""Largest difference between the outputs of the file and of the trained policy, as a share of Φ:
pixels and large weights are summed, in an order that differs between libraries."""
NEUTRAL_WRAPPERS: tuple[type[Any], ...] = (
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
"""Wrappers of environments that change neither observations nor actions."""
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

    model: PPO or A2C with an `MlpPolicy` of tanh or relu; its environment has no wrappers but
        `NEUTRAL_WRAPPERS` and those of rewards
    note: text for the user, stored in the file

    Warns of a policy that stalls. Raises `PolicyError` for any other model, and where the outputs
    of the file would differ from those of the policy.
    """
    path = Path(target)
    env = _find_swim_env(model.get_env(), path)
    if env.extractor:
        raise PolicyError(
            f"{path}: a model that sees pictures is not exported from Python; train it with "
            "'fishctl learn ppo --see camera'"
        )
    policy = _check_network(model.policy, path)
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
    decide = DeterministicPolicy(policy, env.perception, card.amplitude)
    evaluation = evaluate_in_simulation(env.config, decide, EvaluationSettings())
    _write(path, _complete_card(card, evaluation), policy, env.perception, _observe(env))
    if evaluation.is_stalled:
        rollout = cast(OnPolicyAlgorithm, model).n_steps * model.n_envs
        warnings.warn(
            f"{path}: {_format_stall(evaluation)}; it learned from "
            f"{model.num_timesteps // rollout} × {rollout} steps: more updates help, from more "
            "steps or a smaller n_steps",
            stacklevel=2,
        )
    return path


def _format_stall(evaluation: Evaluation) -> str:
    """Return that a policy stalls, with its figures."""
    return (
        "this policy stalls when it swims without exploration: "
        f"{evaluation.frequency:.2f} Hz, |φ_c| {evaluation.fullness:.0%} of Φ"
    )


def _find_swim_env(env: VecEnv | None, path: Path) -> SwimEnv:
    """Return the environment of a model; raise `PolicyError` if a wrapper changes what passes."""
    while isinstance(env, VecEnvWrapper):
        _check_wrapper(env, path)
        env = env.venv
    inner = env.envs if isinstance(env, DummyVecEnv) else []
    for layer in (layer for environment in inner for layer in _unwrap(environment)):
        _check_wrapper(layer, path)
    innermost = inner[0].unwrapped if inner else None
    if not isinstance(innermost, SwimEnv):
        raise PolicyError(
            f"{path}: the environment of this model, {type(innermost or env).__name__}, is not a "
            "SwimEnv of this process, so the inputs of the network are not known; load the model "
            "with env=gymnasium.make('fishd/Swim-v0')"
        )
    return innermost


def _unwrap(env: Any) -> Iterator[Any]:
    """Yield the wrappers of an environment, from the outside."""
    while isinstance(env, gymnasium.Wrapper):
        yield env
        env = env.env


def _check_wrapper(wrapper: Any, path: Path) -> None:
    """Raise `PolicyError` for a wrapper that may change observations or actions."""
    kind = type(wrapper)
    is_reward = (
        isinstance(wrapper, gymnasium.RewardWrapper)
        and kind.step is gymnasium.RewardWrapper.step
        and kind.reset is gymnasium.Wrapper.reset
    ) or (kind is VecNormalize and not wrapper.norm_obs)
    if kind not in NEUTRAL_WRAPPERS and not is_reward:
        remedy = {
            wrappers.NormalizeObservation: "; the observations of a SwimEnv are about 1 already",
            VecNormalize: " or with norm_obs=False; the observations of a SwimEnv are about 1 "
            "already",
        }.get(kind, "")
        raise PolicyError(
            f"{path}: this model was trained behind the wrapper {kind.__name__}, which may change "
            "observations or actions; a policy file has no wrappers, so the policy would swim "
            f"otherwise: train it without that one{remedy}"
        )


def _check_network(policy: Any, path: Path) -> ActorCriticPolicy:
    """Return the policy; raise `PolicyError` for a network that a policy file cannot have."""
    needed = "a policy file has the MlpPolicy of PPO or A2C"
    if type(policy) is not ActorCriticPolicy or type(policy.mlp_extractor) is not MlpExtractor:
        raise PolicyError(f"{path}: {needed}, not {type(policy).__name__}")
    if type(policy.features_extractor) is not FlattenExtractor:
        extractor = type(policy.features_extractor).__name__
        raise PolicyError(f"{path}: {needed} without the extractor of features {extractor}")
    if policy.squash_output:
        raise PolicyError(f"{path}: {needed} without squash_output")
    activation = activation_of(policy)
    for part in (*policy.mlp_extractor.policy_net, policy.action_net):
        if type(part) not in (torch.nn.Linear, policy.activation_fn):
            layers = f"linear layers and {activation}"
            raise PolicyError(f"{path}: {needed} with {layers}, not with {type(part).__name__}")
    for parameter in policy.parameters():
        if parameter.dtype is not torch.float32:
            kind = str(parameter.dtype).removeprefix("torch.")
            raise PolicyError(
                f"{path}: {needed} in float32, this one is in {kind}: call model.policy.float()"
            )
    return policy


def _observe(env: SwimEnv) -> NDArray[np.float32]:
    """Return observations of random swimming in simulation: the model's own fish may be a real one.

    Wrappers that are permitted do not change them.
    """
    simulated = SwimEnv(SimulatedLink(env.config), env.config, env.settings)
    random = np.random.default_rng(2)
    rows = [simulated.reset(seed=2)[0]]
    while len(rows) < _PROBE_INPUTS:
        action = random.uniform(-1.0, 1.0, simulated.action_space.shape).astype(np.float32)
        observation, _, *ended, _ = simulated.step(action)
        rows.append(simulated.reset()[0] if any(ended) else observation)
    return np.array(rows)


def _write(
    target: Path,
    card: Card,
    policy: ActorCriticPolicy,
    perception: Perception,
    observations: NDArray[np.float32] | None = None,
) -> int:
    """Write the file atomically; return its size [bytes]. Raises `PolicyError`.

    observations: inputs on which the file is compared with the policy; None for random ones
    """
    sight = _make_sight(policy, perception)
    content = to_onnx(layers_of(policy), activation_of(policy), card, sight)
    _verify(PolicyFile(target, content, card), policy, perception, observations)
    if not target.name or (target.exists() and not target.is_file()):
        raise PolicyError(f"{target}: exists already, and is not a regular file")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, content)
    except OSError as error:
        raise PolicyError(f"{target}: cannot be written: {error.strerror}") from None
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


def _verify(
    file: PolicyFile,
    policy: ActorCriticPolicy,
    perception: Perception,
    observations: NDArray[np.float32] | None = None,
) -> None:
    """Compare the file, run as on the robot, with the policy; raises `PolicyError`."""
    network = Network(file)
    random = np.random.default_rng(0)
    stacks = _probe_stacks(file.card)
    number = len(stacks) or _PROBE_INPUTS
    rows = observations
    if rows is None:
        rows = random.normal(0.0, 1.5, (number, file.card.numbers)).astype(np.float32)
    given, outputs = [], []
    for index, row in enumerate(rows):
        network.row[:] = row
        seen = row
        if perception.extractor:
            network.frames[:] = stacks[index]
            seen = np.concatenate((perception.extractor.see(stacks[index]), row))
        given.append(seen)
        outputs.append(network.run())
    expected = policy.predict(np.array(given), deterministic=True)[0][:, 0]
    worst = float(np.abs(np.array(outputs) - expected).max())
    if not worst <= TOLERANCE:
        layers = MeanAction(policy)
        computed = np.clip([layers(row) for row in np.array(given)], -1.0, 1.0)
        cause = (
            "this version of onnxruntime computes its layers wrongly: install another one"
            if np.abs(computed - expected).max() <= TOLERANCE
            else "the model does more than its layers, which a policy file cannot have"
        )
        raise PolicyError(
            f"the outputs of the file differ from those of the policy by up to {worst:.2g} of Φ: "
            f"{cause}"
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
