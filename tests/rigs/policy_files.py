"""Policies with known results, and files that only resemble policies."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper

from fishd.controllers.policy import file
from fishd.controllers.policy.card import (
    CARD_KEY,
    Card,
    Feature,
    FeatureName,
    History,
    Provenance,
    StackSettings,
    encode,
)
from fishd.controllers.policy.file import seal
from fishd.controllers.policy.network import Layer, Sight, to_onnx
from fishd.core.errors import PolicyError
from fishd.core.signals import Observation

PROVENANCE = Provenance(
    created="2026-11-21T07:00:00+00:00",
    fishd="0.1.0",
    algorithm="by hand",
    on="simulation",
    steps=8000,
    seed=3,
    settings={"ppo": {"n_steps": 128}},
    plant={"omega0": 12.5},
    libraries={"numpy": np.__version__},
    relative_thrust=0.987,
    frequency=1.67,
)


def card(*features: tuple[Any, ...], tick: float = 0.05, amplitude: float = 0.42) -> Card:
    """Return a card; by default the policy sees the current angle, over Φ."""
    return Card(
        observation=tuple(Feature(*f) for f in features or (("instruction_angle", 0.42),)),
        tick=tick,
        amplitude=amplitude,
        provenance=PROVENANCE,
    )


def vector(features: Sequence[Feature], observation: Observation) -> NDArray[np.float32]:
    """Return the input of a network without a history."""
    history = History(tuple(features))
    history.push(observation)
    return history.row


def linear(*weights: float, bias: float = 0.0) -> list[Layer]:
    """Return one layer, the weighted sum of the inputs."""
    return [(np.array([weights]), np.array([bias]))]


def random_layers(*sizes: int, seed: int = 0) -> list[Layer]:
    """Return random layers of these sizes, from the inputs on."""
    draw = np.random.default_rng(seed)
    return [
        (draw.normal(0.0, before**-0.5, (after, before)), draw.normal(0.0, 0.1, after))
        for before, after in pairwise(sizes)
    ]


def answer(layers: Sequence[Layer], activation: str, inputs: NDArray[Any]) -> float:
    """Return the output of a network, computed in double precision."""
    value = np.asarray(inputs, np.float64)
    for number, (weight, bias) in enumerate(layers):
        value = weight @ value + bias
        if number < len(layers) - 1:
            value = np.tanh(value) if activation == "tanh" else np.maximum(value, 0.0)
    return float(np.clip(value.item(), -1.0, 1.0))


def seeing_card(
    *features: tuple[FeatureName, float], pictures: StackSettings | None = None, tick: float = 0.05
) -> Card:
    """Return a card; by default the policy sees only two frames of 32 x 32 pixels."""
    return Card(
        observation=tuple(Feature(*f) for f in features),
        pictures=pictures or StackSettings(size=32, frames=2, delay=0.02),
        tick=tick,
        amplitude=0.42,
        provenance=PROVENANCE,
    )


def of_pixels(weights: NDArray[Any], about: Card, *others: float) -> bytes:
    """Return a policy with the weighted sum of all grey levels, followed by its other inputs.

    weights: shape (frames, size, size)
    """
    pixels = weights.size
    nodes = [
        helper.make_node("Cast", [file.FRAMES], ["grey"], to=TensorProto.FLOAT),
        helper.make_node("Reshape", ["grey", "row"], ["pixels"]),
    ]
    out = "pixels"
    if about.observation:
        nodes.append(helper.make_node("Concat", ["pixels", file.INPUT], ["all"], axis=1))
        out = "all"
    layer = np.array([[*weights.ravel(), *others]]), np.zeros(1)
    sight = Sight(nodes, {"row": np.array([1, pixels])}, out, pixels + len(others))
    return to_onnx([layer], "tanh", about, sight)


def velocity_follower(gain: float = 4.0, about: Card | None = None) -> bytes:
    """Return a policy that drives the tail in the direction of its motion, so that it swims.

    The tail is dark, so the upper half of a frame becomes lighter as the tail goes to higher rows.

    gain: Φ per grey level of the change of the difference between the halves
    """
    policy_card = about or seeing_card()
    assert policy_card.pictures
    size = policy_card.pictures.size
    halves = np.where(np.arange(size) < size / 2, 1.0, -1.0)[:, None] * np.full(size, 2.0 / size**2)
    weights = np.zeros(policy_card.pictures.shape)
    weights[:2] = gain * halves, -gain * halves
    return of_pixels(weights, policy_card)


FLIP = to_onnx(linear(-100.0, bias=1.0), "tanh", card())
"""Policy that commands the other side, from neutral to plus: a square wave of two ticks."""


def of_nodes(
    nodes: Sequence[Any], weights: Sequence[Any] = (), about: Card | None = None, opset: int = 17
) -> bytes:
    """Return a policy of nodes from `observation` to `action`, both of shape [1, 1]."""
    numbers = (TensorProto.FLOAT, [1, 1])
    ends = [[helper.make_tensor_value_info(name, *numbers)] for name in (file.INPUT, file.OUTPUT)]
    graph = helper.make_graph(list(nodes), "policy", *ends, list(weights))
    model = helper.make_model(graph, ir_version=8, opset_imports=[helper.make_opsetid("", opset)])
    helper.set_model_props(model, {CARD_KEY: encode(about or card())})
    return seal(model)


def refusal(content: bytes) -> str:
    """Return the line that says why a file is not a policy."""
    with pytest.raises(PolicyError) as caught:
        file.parse(content)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def write(folder: Path, content: bytes = FLIP, name: str = "flip") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.onnx"
    path.write_bytes(content)
    return path
