"""From a checkpoint, or a model of one's own, to the one file that the controller `ppo` runs."""

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
from fishd.errors import FishdError, PolicyError
from fishd.learning import checkpoints, runs
from fishd.learning.environment import SwimEnv
from fishd.learning.ppo import Deterministic, activation_of, layers_of
from fishd.learning.provenance import make_card
from fishd.learning.settings import EvaluationSettings, TrainingSettings
from fishd.learning.trials import Trial, in_simulation
from fishd.learning.whole import write_whole
from fishd.plant.optimum import best_square_wave
from fishd.plant.parameters import PlantParameters
from fishd.policies.card import Card
from fishd.policies.file import PolicyFile
from fishd.policies.network import to_onnx
from fishd.policies.runtime import Network

TOLERANCE = 1e-5
"""The file must say what the trained policy says, to this share of Φ."""
_PROBES = 1000


class Exported(Struct, frozen=True):
    """What was written."""

    path: Path
    checkpoint: Path
    card: Card
    trial: Trial
    size: int
    """[bytes]"""


def export(checkpoint: Path, target: Path, *, force: bool = False, note: str = "") -> Exported:
    """Write the policy of a checkpoint to `target`, once it is known to be right.

    force: also where it stalls
    note: for people, kept in the file

    Raises `CheckpointError`, and `PolicyError` where the policy stalls or the file would not say
    what the policy says.
    """
    card = checkpoints.read_card(checkpoint)
    policy = checkpoints.load_policy(checkpoint)
    settings = msgspec.convert(card.provenance.settings, TrainingSettings)
    trial = _swim(checkpoint, card, policy, settings)
    if trial.stalled and not force:
        raise PolicyError(
            f"{checkpoint}: this policy stalls when it swims without exploration: "
            f"{trial.frequency:.2f} Hz, |φ_c| {trial.fullness:.0%} of Φ; train longer, choose "
            "another checkpoint, or export it all the same with --force"
        )
    card = _completed(card, trial, note)
    size = _write(target, card, policy)
    return Exported(target, checkpoint, card, trial, size)


def export_model(model: BaseAlgorithm, target: str | Path, note: str = "") -> Path:
    """Write the policy of a model of stable-baselines3 that was trained on a `SwimEnv`.

    model: PPO or A2C with an `MlpPolicy` of tanh or relu, and without `VecNormalize`: it would see
        what the policy file does not know of
    note: for people, kept in the file

    Raises `PolicyError` for any other, and where the file would not say what the policy says.
    """
    path = Path(target)
    vec_env, policy = model.get_env(), model.policy
    env = vec_env.envs[0].unwrapped if isinstance(vec_env, DummyVecEnv) else None
    if not isinstance(env, SwimEnv):
        raise PolicyError(
            f"{path}: the environment of this model, {type(vec_env).__name__}, is not a SwimEnv "
            "alone: what the network sees cannot be told"
        )
    if not isinstance(policy, ActorCriticPolicy) or not isinstance(
        policy.features_extractor, FlattenExtractor
    ):
        raise PolicyError(f"{path}: {type(policy).__name__} is no MlpPolicy of PPO or A2C")
    card = make_card(env.config, TrainingSettings(), env.features, "a SwimEnv", 0, None, note)
    past = replace(
        card.provenance,
        algorithm=type(model).__name__,
        steps=model.num_timesteps,
        seed=model.seed or 0,
        settings={"environment": msgspec.to_builtins(env.settings)},
    )
    card = replace(card, provenance=past)
    decide = Deterministic(policy, card.observation, card.amplitude)
    trial = in_simulation(env.config, decide, EvaluationSettings())
    _write(path, _completed(card, trial, ""), policy)
    return path


def _write(target: Path, card: Card, policy: ActorCriticPolicy) -> int:
    """Write the file, whole or not at all; its size [bytes]. Raises `PolicyError`."""
    content = to_onnx(layers_of(policy), activation_of(policy), card)
    _verify(PolicyFile(target, content, card), policy)
    if not target.name or (target.exists() and not target.is_file()):
        raise PolicyError(f"{target}: is there already, and is no regular file")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_whole(target, content)
    except OSError as error:
        raise PolicyError(f"{target}: cannot be written: {error.strerror}") from None
    return len(content)


def _swim(
    checkpoint: Path, card: Card, policy: ActorCriticPolicy, settings: TrainingSettings
) -> Trial:
    """How the policy swims: as last seen on the robot, else the simulated fish of its training."""
    state = checkpoints.read_state(checkpoint)
    seen = state.latest
    if seen and state.on == "robot" and seen.steps == state.steps:
        return Trial(seen.thrust, seen.frequency, seen.fullness, card.tick)
    decide = Deterministic(policy, card.observation, card.amplitude)
    return in_simulation(_fish(checkpoint, card), decide, settings.evaluation)


def _fish(checkpoint: Path, card: Card) -> Config:
    """The fish of the run, imperfections of its rig included where its folder is still there."""
    try:
        config, _ = runs.read(checkpoint.parent)
    except FishdError:
        config = Config()
    return replace(
        config,
        tick=card.tick,
        amplitude_limit=card.amplitude,
        plant=msgspec.convert(card.provenance.plant, PlantParameters),
    )


def _completed(card: Card, trial: Trial, note: str) -> Card:
    """The card with what the last evaluation says, and the note."""
    past = card.provenance
    plant = msgspec.convert(past.plant, PlantParameters)
    best = float(best_square_wave(plant, card.amplitude).thrust)
    return replace(
        card,
        provenance=replace(
            past,
            efficiency=trial.thrust / best,
            frequency=trial.frequency,
            note="; ".join(part for part in (past.note, note) if part),
        ),
    )


def _verify(file: PolicyFile, policy: ActorCriticPolicy) -> None:
    """Compare what the robot will run with the policy, on random observations.

    Raises `PolicyError`.
    """
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
            f"the file would say something else than the policy, by up to {worst:.2g} of Φ: "
            "this onnxruntime cannot be trusted with it"
        )
