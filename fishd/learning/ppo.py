"""PPO of stable-baselines3 as configured by fishd, and its policy as layers."""

from collections.abc import Generator, Sequence
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from stable_baselines3.common.vec_env import VecEnv
from torch.nn import Linear

from fishd.controllers.policy.card import READING, is_even
from fishd.controllers.policy.runtime import HOLD_TIME_S
from fishd.core.camera_frames import Stack
from fishd.core.errors import PolicyError
from fishd.core.signals import Observation
from fishd.learning.env.environment import spaces
from fishd.learning.env.perception import Perception
from fishd.learning.extractors import FeatureExtractor
from fishd.learning.picture_networks import (
    HALF,
    PairExtractor,
    PictureExtractor,
    SymmetricExtractor,
)
from fishd.learning.settings import PpoSettings, TrainingSettings
from fishd.learning.thrust_signal import ThrustSignal

_OPTIMISER: dict[str, Any] = {"eps": 1e-5, "fused": True}
"""Options of Adam: the smallest denominator of stable-baselines3, and a faster step."""
Layers = list[tuple[NDArray[np.float32], NDArray[np.float32]]]
"""Weights, shape (outputs, inputs), and biases of each layer."""


class SymmetricPolicy(ActorCriticPolicy):
    """PPO's networks with left-right symmetry: a mirrored fish gets the mirrored action.

    All inputs (F_y, its rate, the fin velocity, φ_c) change sign when left and right are swapped,
    and so does the action; the value of a state and F_x do not. The networks have this symmetry by
    construction, so it need not be learned, and no policy can favour one side. The bias of the
    policy's last layer stays zero.
    """

    def __init__(self, *arguments: Any, even: Sequence[int] = (), **options: Any) -> None:
        """even: indices of the inputs that are the same for the mirrored fish, such as F_x"""
        self._even = even
        super().__init__(*arguments, **options)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = SymmetricExtractor(
            self.features_dim,
            even=self._even,
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            device=self.device,
        )

    def _build(self, lr_schedule: object) -> None:
        super()._build(lr_schedule)  # type: ignore[arg-type]
        self.action_net.bias.requires_grad_(False)


class SymmetricPicturePolicy(SymmetricPolicy):
    """A `SymmetricPolicy` for pictures: they are flipped, the other numbers change sign."""

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = PairExtractor(
            self.features_dim // 2,
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            device=self.device,
        )


def plain_layers(layers: Layers, mirror: NDArray[np.float32]) -> Layers:
    """Return the layers of a `SymmetricPolicy` as those of an ordinary network of twice the width.

    Its upper half receives the input, its lower half the mirrored input.

    mirror: factors from the input to the mirrored one, shape (inputs,)
    """
    (first, bias), *inner, (last, last_bias) = layers
    doubled = [(np.vstack((first, first * mirror)), np.tile(bias, 2))]
    for weight, bias in inner:
        zero = np.zeros_like(weight)
        doubled.append((np.block([[weight, zero], [zero, weight]]), np.tile(bias, 2)))
    return [*doubled, (np.float32(HALF) * np.hstack((last, -last)), last_bias)]


_ACTIVATIONS: dict[Literal["tanh", "relu"], type[torch.nn.Module]] = {
    "tanh": torch.nn.Tanh,
    "relu": torch.nn.ReLU,
}


class Rollout(RolloutBuffer):
    """The steps of one update, without the void ones.

    A step is void if an angle other than the agent's action was applied: its outcome must not be
    credited to the action, nor, through the advantages, to those before it.
    """

    signal: ThrustSignal | None = None
    """Estimator of the thrust from the measured forces; None: F_x is used unchanged."""
    reward_per_newton = 0.0
    """Factor of F_x in the rewards [1/N]."""

    def reset(self) -> None:
        """Forget all steps."""
        super().reset()
        self.void = np.zeros(self.buffer_size, dtype=bool)
        """True for each void step."""
        self.forces = np.zeros((self.buffer_size, 2))
        """F_x and F_y in the tick of each reward [N]."""

    def compute_returns_and_advantage(
        self, last_values: torch.Tensor, dones: NDArray[np.bool_]
    ) -> None:
        """Compute them as in PPO; a void step has its value as outcome, and ends its episode."""
        if self.signal:
            fx, fy = self.forces[~self.void].T
            cleaned = self.signal.estimate(fx, fy) - fx
            self.rewards[~self.void, 0] += self.reward_per_newton * cleaned
        self.rewards[self.void] = self.values[self.void]
        super().compute_returns_and_advantage(last_values, dones)

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        """Yield minibatches in random order, of all steps except the void ones."""
        for batch in super().get(batch_size):
            if len(batch.advantages) > 1:  # PPO divides by their standard deviation
                yield batch

    def _get_samples(self, batch_inds: NDArray[np.int64], env: Any = None) -> RolloutBufferSamples:
        return super()._get_samples(batch_inds[~self.void[batch_inds]], env)


def make_learner(
    settings: TrainingSettings, env: VecEnv, extractor: FeatureExtractor | None = None
) -> PPO:
    """Return a new PPO with an untrained policy; seed torch, numpy and the environment."""
    ppo = settings.ppo
    return PPO(
        _policy_class(ppo, extractor),
        env,
        learning_rate=ppo.learning_rate,
        n_steps=ppo.n_steps,
        batch_size=ppo.batch_size,
        n_epochs=ppo.n_epochs,
        gamma=ppo.gamma,
        gae_lambda=ppo.gae_lambda,
        clip_range=ppo.clip_range,
        ent_coef=ppo.ent_coef,
        vf_coef=ppo.vf_coef,
        max_grad_norm=ppo.max_grad_norm,
        target_kl=ppo.target_kl,
        rollout_buffer_class=Rollout,
        policy_kwargs=_policy_arguments(ppo, extractor, even_inputs(settings)),
        seed=settings.seed,
        device="cpu",
    )


def make_policy(
    ppo: PpoSettings,
    numbers: int,
    extractor: FeatureExtractor | None = None,
    even: Sequence[int] = (),
) -> ActorCriticPolicy:
    """Return the networks alone, as in `make_learner`.

    numbers: number of inputs beside the outputs of the feature extractor
    even: indices of the inputs that are the same for the mirrored fish
    """
    observation, action = spaces(numbers + (extractor.outputs if extractor else 0))
    return _policy_class(ppo, extractor)(
        observation, action, lambda _: ppo.learning_rate, **_policy_arguments(ppo, extractor, even)
    )


def even_inputs(settings: TrainingSettings) -> list[int]:
    """Return the indices of the inputs that are the same for the mirrored fish."""
    seen = settings.seen
    names = (*seen.observation, *(READING + name for name in seen.readings)) * seen.history
    return [index for index, name in enumerate(names) if is_even(name)]


def _policy_class(ppo: PpoSettings, extractor: FeatureExtractor | None) -> type[ActorCriticPolicy]:
    if not ppo.symmetric:
        return ActorCriticPolicy
    return SymmetricPicturePolicy if extractor and extractor.shape else SymmetricPolicy


def _policy_arguments(
    ppo: PpoSettings, extractor: FeatureExtractor | None, even: Sequence[int]
) -> dict[str, Any]:
    arguments: dict[str, Any] = {
        "net_arch": {"pi": list(ppo.hidden), "vf": list(ppo.hidden)},
        "activation_fn": _ACTIVATIONS[ppo.activation],
        "log_std_init": ppo.log_std_init,
        "optimizer_kwargs": _OPTIMISER,
    }
    if ppo.symmetric and even:
        arguments["even"] = even
    if extractor and extractor.shape:
        arguments["features_extractor_class"] = PictureExtractor
        arguments["features_extractor_kwargs"] = {
            "shape": extractor.shape,
            "kind": extractor.network,
            "mirrored": ppo.symmetric,
        }
    return arguments


def learning_rate(ppo: PpoSettings, steps: int) -> float:
    """Return the learning rate of the update that is `steps` control steps after the start."""
    share = min(1.0, steps / ppo.decay_steps)
    return ppo.learning_rate + share * (ppo.final_learning_rate - ppo.learning_rate)


def layers_of(policy: ActorCriticPolicy) -> Layers:
    """Return the layers of the deterministic policy, from its inputs to the mean of the action.

    If the policy sees a picture, its features are the inputs. The last layer of a
    `SymmetricPicturePolicy` receives the hidden outputs for the fish, then those for its mirror
    image.
    """
    hidden = [part for part in policy.mlp_extractor.policy_net if isinstance(part, Linear)]
    last = cast(Linear, policy.action_net)
    layers = [
        (
            linear.weight.detach().cpu().numpy().astype(np.float32),
            np.zeros(linear.out_features, np.float32)
            if linear.bias is None
            else linear.bias.detach().cpu().numpy().astype(np.float32),
        )
        for linear in (*hidden, last)
    ]
    if isinstance(policy, SymmetricPicturePolicy):
        *inner, (weight, bias) = layers
        return [*inner, (np.float32(HALF) * np.hstack((weight, -weight)), bias)]
    if isinstance(policy.mlp_extractor, SymmetricExtractor):
        return plain_layers(layers, policy.mlp_extractor.mirror.numpy())
    return layers


def activation_of(policy: ActorCriticPolicy) -> Literal["tanh", "relu"]:
    """Return the activation function; raises `PolicyError` for any other than these two."""
    used = {type(part) for part in policy.mlp_extractor.policy_net} - {Linear}
    for name, kind in _ACTIVATIONS.items():
        if used <= {kind}:
            return name
    names = ", ".join(sorted(kind.__name__ for kind in used))
    raise PolicyError(f"activation {names} cannot be exported; Tanh or ReLU is needed")


def is_finite(model: PPO) -> bool:
    """Return False if the training has diverged."""
    return all(bool(torch.isfinite(p).all()) for p in model.policy.parameters())


class MeanAction:
    """The mean of a policy's action, for one input at a time.

    Plain layers are copied and computed in NumPy, which for a single input is several times as fast
    as torch; a network for pictures runs in torch.
    """

    def __init__(self, policy: ActorCriticPolicy) -> None:
        self._policy = policy
        is_plain = isinstance(policy.features_extractor, FlattenExtractor)
        self._layers = layers_of(policy) if is_plain else []
        self._tanh = is_plain and activation_of(policy) == "tanh"

    def __call__(self, values: NDArray[np.float32]) -> float:
        """Return the mean, which may be beyond ±1."""
        if not self._layers:
            with torch.no_grad():
                action = self._policy.get_distribution(torch.from_numpy(values[None])).mode()
            return float(action[0, 0])
        *hidden, (weight, bias) = self._layers
        for inner, offset in hidden:
            values = inner @ values + offset
            values = np.tanh(values) if self._tanh else np.maximum(values, 0.0)
        return float((weight @ values + bias)[0])


class DeterministicPolicy:
    """A policy without exploration, from an observation to an instruction angle [rad]."""

    def __init__(self, policy: ActorCriticPolicy, perception: Perception, amplitude: float) -> None:
        """amplitude: Φ [rad]"""
        self._perception = perception.with_new_history()
        self._amplitude = amplitude
        self._latest = self._blind = 0.0
        self._mean = MeanAction(policy)

    def __call__(self, observation: Observation, stack: Stack | None = None) -> float:
        """Return the angle for an observation [rad].

        If frames are needed and missing, hold the last angle for `HOLD_TIME_S`, then return
        neutral.
        """
        if stack is None and self._perception.extractor:
            self._perception.note(observation)
            self._blind += observation.dt
            return self._latest if self._blind <= HOLD_TIME_S else 0.0
        self._blind = 0.0
        action = self._mean(self._perception.vector(observation, stack))
        self._latest = max(-1.0, min(1.0, action)) * self._amplitude
        return self._latest
