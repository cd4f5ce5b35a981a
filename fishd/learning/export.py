"""Writes a checkpoint, or any model of stable-baselines3, to one file for the controller `ppo`."""

from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv

from fishd.config import Config
from fishd.controllers.policy.card import Card
from fishd.controllers.policy.file import PolicyFile
from fishd.controllers.policy.network import to_onnx
from fishd.controllers.policy.runtime import Network
from fishd.core.errors import FishdError, PolicyError
from fishd.core.files import write_atomically
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Evaluation, in_simulation
from fishd.learning.env.perception import Perception
from fishd.learning.ppo import DeterministicPolicy, activation_of, layers_of
from fishd.learning.run_folder import checkpoints, runs
from fishd.learning.run_folder.runs import make_card
from fishd.learning.settings import EvaluationSettings, TrainingSettings
from fishd.virtual.plant.parameters import PlantParameters

TOLERANCE = 1e-5
"""Largest difference between the outputs of the file and of the trained policy, as a share of Φ."""
_PROBES = 1000


class Exported(Struct, frozen=True):
    """What was written."""

    path: Path
    checkpoint: Path
    card: Card
    evaluation: Evaluation
    size: int
    """[bytes]"""


def export(checkpoint: Path, target: Path, *, force: bool = False, note: str = "") -> Exported:
    """Evaluate the policy of a checkpoint, and write it to `target`.

    force: also where it stalls
    note: for people, kept in the file

    Raises `CheckpointError`, and `PolicyError` where the policy stalls or the file would give other
    outputs than the policy.
    """
    card = checkpoints.read_card(checkpoint)
    policy, perception = checkpoints.load_policy(checkpoint)
    found = _evaluated(checkpoint, card, policy, perception)
    if found.stalled and not force:
        raise PolicyError(
            f"{checkpoint}: this policy stalls when it swims without exploration: "
            f"{found.frequency:.2f} Hz, |φ_c| {found.fullness:.0%} of Φ; train longer, choose "
            "another checkpoint, or export it all the same with --force"
        )
    card = _completed(card, found, note)
    size = _write(target, card, policy)
    return Exported(target, checkpoint, card, found, size)


def export_model(model: BaseAlgorithm, target: str | Path, note: str = "") -> Path:
    """Write the policy of a model of stable-baselines3 that was trained on a `SwimEnv`.

    model: PPO or A2C with an `MlpPolicy` of tanh or relu, and without `VecNormalize`, whose
        averages are no part of a policy file
    note: for people, kept in the file

    Raises `PolicyError` for any other, and where the file would give other outputs than the policy.
    """
    path = Path(target)
    vec_env, policy = model.get_env(), model.policy
    env = vec_env.envs[0].unwrapped if isinstance(vec_env, DummyVecEnv) else None
    if not isinstance(env, SwimEnv):
        raise PolicyError(
            f"{path}: the environment of this model, {type(vec_env).__name__}, is not a SwimEnv "
            "alone, so the inputs of the network are not known"
        )
    if not isinstance(policy, ActorCriticPolicy) or not isinstance(
        policy.features_extractor, FlattenExtractor
    ):
        raise PolicyError(f"{path}: {type(policy).__name__} is not an MlpPolicy of PPO or A2C")
    card = make_card(env.config, TrainingSettings(), env.features, "a SwimEnv", 0, None, note)
    past = replace(
        card.provenance,
        algorithm=type(model).__name__,
        steps=model.num_timesteps,
        seed=model.seed or 0,
        settings={"environment": msgspec.to_builtins(env.settings)},
    )
    card = replace(card, provenance=past)
    decide = DeterministicPolicy(policy, env.perception, card.amplitude)
    _write(path, _completed(card, in_simulation(env.config, decide, EvaluationSettings())), policy)
    return path


def _write(target: Path, card: Card, policy: ActorCriticPolicy) -> int:
    """Write the file atomically; its size [bytes]. Raises `PolicyError`."""
    content = to_onnx(layers_of(policy), activation_of(policy), card)
    _verify(PolicyFile(target, content, card), policy)
    if not target.name or (target.exists() and not target.is_file()):
        raise PolicyError(f"{target}: exists already, and is not a regular file")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(target, content)
    except OSError as error:
        raise PolicyError(f"{target}: cannot be written: {error.strerror}") from None
    return len(content)


def _evaluated(
    checkpoint: Path, card: Card, policy: ActorCriticPolicy, perception: Perception
) -> Evaluation:
    """The latest evaluation on the robot, else one on the simulated fish of its training."""
    state = checkpoints.read_state(checkpoint)
    if state.on == "robot" and state.latest and state.latest.steps == state.steps:
        return state.latest
    try:  # with the imperfections of its rig, where the run folder still exists
        config, _ = runs.read(checkpoint.parent)
    except FishdError:
        config = Config()
    plant = msgspec.convert(card.provenance.plant, PlantParameters)
    config = replace(config, tick=card.tick, amplitude_limit=card.amplitude, plant=plant)
    decide = DeterministicPolicy(policy, perception, card.amplitude)
    settings = msgspec.convert(card.provenance.settings, TrainingSettings)
    return in_simulation(config, decide, settings.evaluation)


def _completed(card: Card, evaluation: Evaluation, note: str = "") -> Card:
    """The card with the figures of an evaluation, and the note."""
    past = replace(
        card.provenance,
        efficiency=evaluation.efficiency,
        frequency=evaluation.frequency,
        note="; ".join(part for part in (card.provenance.note, note) if part),
    )
    return replace(card, provenance=past)


def _verify(file: PolicyFile, policy: ActorCriticPolicy) -> None:
    """Compare the file, run as on the robot, with the policy; raises `PolicyError`."""
    network = Network(file)
    shape = (_PROBES, len(file.card.observation))
    probes = np.random.default_rng(0).normal(0.0, 1.5, shape).astype(np.float32)
    wanted, _ = policy.predict(probes, deterministic=True)
    worst = 0.0
    for probe, action in zip(probes, wanted, strict=True):
        network.row[:] = probe
        worst = max(worst, abs(network.run() - float(action[0])))
    if not worst <= TOLERANCE:
        raise PolicyError(
            f"with this onnxruntime, the outputs of the file differ from those of the policy, by "
            f"up to {worst:.2g} of Φ; install another version of it"
        )
