"""Networks for pictures, and hidden layers with left-right symmetry."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor, NatureCNN
from torch import nn

from fishd.learning.extractors import Nodes

PictureKind = Literal["cnn", "nature"]
Shape = tuple[int, int, int]

SMALL = 64
"""Number of features of a picture in the small network."""
LARGE = 512
"""Number of features of a picture in the network of Mnih et al."""

HALF = math.sqrt(0.5)
"""Factor that gives an untrained network's output the same spread as without symmetry."""


def small_network(shape: Shape) -> nn.Sequential:
    """Return three convolutions of stride 2, and one layer; shape: channels, height, width."""
    layers = [
        nn.Conv2d(shape[0], 16, 5, 2),
        nn.ReLU(),
        nn.Conv2d(16, 32, 3, 2),
        nn.ReLU(),
        nn.Conv2d(32, 32, 3, 2),
        nn.ReLU(),
        nn.Flatten(),
    ]
    with torch.no_grad():
        width = nn.Sequential(*layers)(torch.zeros(1, *shape)).shape[1]
    return nn.Sequential(*layers, nn.Linear(width, SMALL), nn.ReLU())


def nature_network(shape: Shape) -> nn.Sequential:
    """Return the network of Mnih et al.: "Human-level control through deep reinforcement learning",
    2015.
    """
    space: Any = gymnasium.spaces.Box(0.0, 1.0, shape, np.float32)
    whole = NatureCNN(space, LARGE, normalized_image=True)
    return nn.Sequential(*whole.cnn, *whole.linear)


def network_nodes(network: nn.Sequential, picture: str, out: str) -> Nodes:
    """Return a network of convolutions and layers as operators of ONNX.

    picture: name of the input, shape (batch, channels, height, width)
    out: name of the output, shape (batch, width)
    """
    from onnx import helper

    nodes: list[Any] = []
    constants: dict[str, NDArray[Any]] = {}
    value = picture
    for number, part in enumerate(network):
        after = out if number == len(network) - 1 else f"seen_{number}"
        given = [value]
        if isinstance(part, nn.Conv2d | nn.Linear):
            for name, tensor in (("weight", part.weight), ("bias", part.bias)):
                assert tensor is not None
                given.append(f"seeing_{name}_{number}")
                constants[given[-1]] = tensor.detach().numpy().astype(np.float32)
        if isinstance(part, nn.Conv2d):
            node = helper.make_node("Conv", given, [after], strides=list(part.stride))
        elif isinstance(part, nn.Linear):
            node = helper.make_node("Gemm", given, [after], transB=1)
        else:
            node = helper.make_node(
                "Relu" if isinstance(part, nn.ReLU) else "Flatten", given, [after]
            )
        nodes.append(node)
        value = after
    return nodes, constants


class PictureExtractor(BaseFeaturesExtractor):
    """An extractor that compresses a picture and passes on the numbers beside it.

    The input is flat: the picture's levels, then the other numbers.
    """

    def __init__(
        self, observation_space: Any, shape: Shape, kind: PictureKind, mirrored: bool
    ) -> None:
        """
        shape: channels, height and width of the picture
        mirrored: append the features of the mirrored fish
        """
        self._levels = math.prod(shape)
        others = observation_space.shape[0] - self._levels
        compressed = SMALL if kind == "cnn" else LARGE
        self.single = compressed + others
        """Number of outputs for one picture."""
        super().__init__(observation_space, self.single * (2 if mirrored else 1))
        self._shape, self.mirrored = shape, mirrored
        self.network = small_network(shape) if kind == "cnn" else nature_network(shape)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the features, shape (batch, features_dim)."""
        picture = observations[:, : self._levels].reshape(-1, *self._shape)
        others = observations[:, self._levels :]
        if not self.mirrored:
            return torch.cat((self.network(picture), others), dim=1)
        both = self.network(torch.cat((picture, picture.flip(2))))
        seen, mirrored = both.chunk(2)
        return torch.cat((seen, others, mirrored, -others), dim=1)


class SymmetricExtractor(MlpExtractor):
    """Hidden layers whose output changes sign for a mirrored fish; that for the value does not.

    Attributes:
        mirror: factors, 1 or -1, from the features of a fish to those of its mirror image.
    """

    def __init__(self, feature_dim: int, *, even: Sequence[int] = (), **arguments: Any) -> None:
        """even: indices of the features that are the same for the mirrored fish"""
        super().__init__(feature_dim, **arguments)
        mirror = -torch.ones(feature_dim)
        mirror[list(even)] = 1.0
        self.mirror: torch.Tensor
        self.register_buffer("mirror", mirror, persistent=False)

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Return f(x) − f(mirrored x), over √2."""
        seen, mirrored = self.policy_net(self._both(features)).chunk(2)
        odd: torch.Tensor = HALF * (seen - mirrored)
        return odd

    def forward_critic(self, features: torch.Tensor) -> torch.Tensor:
        """Return the mean of f(x) and f(mirrored x)."""
        seen, mirrored = self.value_net(self._both(features)).chunk(2)
        even: torch.Tensor = 0.5 * (seen + mirrored)
        return even

    def _both(self, features: torch.Tensor) -> torch.Tensor:
        """Return the features of all fish, then those of their mirror images."""
        return torch.cat((features, features * self.mirror))


class PairExtractor(SymmetricExtractor):
    """Hidden layers for features of a fish, and of its mirror image behind them."""

    def _both(self, features: torch.Tensor) -> torch.Tensor:
        return torch.cat(features.chunk(2, dim=1))
