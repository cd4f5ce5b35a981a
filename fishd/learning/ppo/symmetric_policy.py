"""A policy that knows that left and right are alike: a mirrored fish gets the mirrored answer.

All that it sees (F_y, its rate, the fin velocity, φ_c) changes sign when left and right are
swapped, and so does what it does; what a state is worth does not. Built into the networks, half of
what PPO would have to try is known beforehand, and no policy can favour one side. F_x, which has no
sign to change, must not be among what it sees.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor

_HALF = math.sqrt(0.5)
"""Keeps the spread of an untrained network's output what it is without a mirror image."""

Layers = list[tuple[NDArray[np.float32], NDArray[np.float32]]]
"""Weights, shape (outputs, inputs), and biases of each layer."""


class MirrorExtractor(MlpExtractor):
    """Hidden layers seen from both sides: odd in their input for the policy, even for the value."""

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """f(x) − f(−x), over √2."""
        odd: torch.Tensor = self.policy_net(features) - self.policy_net(-features)
        return _HALF * odd

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """The mean of f(x) and f(−x)."""
        even: torch.Tensor = self.value_net(features) + self.value_net(-features)
        return 0.5 * even


class MirrorPolicy(ActorCriticPolicy):
    """PPO's networks with a mirror; the last layer of the policy has a bias that stays zero."""

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = MirrorExtractor(
            self.features_dim,
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            device=self.device,
        )

    def _build(self, lr_schedule: object) -> None:
        super()._build(lr_schedule)  # type: ignore[arg-type]
        self.action_net.bias.requires_grad_(False)


def plain_layers(layers: Layers) -> Layers:
    """The layers of a `MirrorPolicy` as those of an ordinary network of twice the width.

    Its upper half sees what there is, its lower half the mirror image.
    """
    (first, bias), *inner, (last, last_bias) = layers
    doubled = [(np.vstack((first, -first)), np.tile(bias, 2))]
    for weight, bias in inner:
        none = np.zeros_like(weight)
        doubled.append((np.block([[weight, none], [none, weight]]), np.tile(bias, 2)))
    return [*doubled, (np.float32(_HALF) * np.hstack((last, -last)), last_bias)]
