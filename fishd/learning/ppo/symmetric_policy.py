"""A policy with left-right symmetry: a mirrored fish gets the mirrored action.

All inputs (F_y, its rate, the fin velocity, φ_c) change sign when left and right are swapped, and
so does the action; the value of a state does not. The networks are built that way, so the symmetry
need not be learned, and no policy can favour one side. F_x, whose sign does not change, must not be
among the inputs.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor

_HALF = math.sqrt(0.5)
"""Gives an untrained network's output the same spread as without symmetry."""

Layers = list[tuple[NDArray[np.float32], NDArray[np.float32]]]
"""Weights, shape (outputs, inputs), and biases of each layer."""


class SymmetricExtractor(MlpExtractor):
    """Hidden layers that are odd in their input for the policy, even for the value."""

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """f(x) − f(−x), over √2."""
        odd: torch.Tensor = self.policy_net(features) - self.policy_net(-features)
        return _HALF * odd

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """The mean of f(x) and f(−x)."""
        even: torch.Tensor = self.value_net(features) + self.value_net(-features)
        return 0.5 * even


class SymmetricPolicy(ActorCriticPolicy):
    """PPO's networks, symmetric; the bias of the policy's last layer stays zero."""

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = SymmetricExtractor(
            self.features_dim,
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            device=self.device,
        )

    def _build(self, lr_schedule: object) -> None:
        super()._build(lr_schedule)  # type: ignore[arg-type]
        self.action_net.bias.requires_grad_(False)


def plain_layers(layers: Layers) -> Layers:
    """The layers of a `SymmetricPolicy` as those of an ordinary network of twice the width.

    Its upper half gets the input, its lower half the mirrored input.
    """
    (first, bias), *inner, (last, last_bias) = layers
    doubled = [(np.vstack((first, -first)), np.tile(bias, 2))]
    for weight, bias in inner:
        zero = np.zeros_like(weight)
        doubled.append((np.block([[weight, zero], [zero, weight]]), np.tile(bias, 2)))
    return [*doubled, (np.float32(_HALF) * np.hstack((last, -last)), last_bias)]
