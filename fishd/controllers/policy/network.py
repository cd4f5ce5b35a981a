"""Writer of a policy file: a network and its card, as one ONNX model."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.controllers.policy import file
from fishd.controllers.policy.card import CARD_KEY, Card, encode
from fishd.core.errors import PolicyError

Layer = tuple[NDArray[Any], NDArray[Any]]
"""Weights, shape (outputs, inputs), and biases, shape (outputs,)."""

OPSET = 13
"""Version of the operators, which every supported onnxruntime has."""
MAX_WEIGHTS_BYTES = file.MAX_FILE_BYTES - 2**20
"""Maximum size of the weights: the rest is for the card and the operators [bytes]."""

_OPERATORS = {"tanh": "Tanh", "relu": "Relu"}


class Sight(NamedTuple):
    """Operators that convert the inputs of a policy with a camera to those of its first layer."""

    nodes: Sequence[Any]
    """Operators, from `frames` and `observation` to `out`."""
    constants: Mapping[str, NDArray[Any]]
    out: str
    width: int
    """`out` is float32 of shape (1, width); with its mirror image, (2, width)."""
    mirrored: bool = False
    """Whether `out` includes the mirror image; the last layer gets the features of both."""


def to_onnx(
    layers: Sequence[Layer],
    activation: Literal["tanh", "relu"],
    card: Card,
    sight: Sight | None = None,
) -> bytes:
    """Return a policy file: layers with activations, and the last output clipped to [-1, 1].

    Inputs `frames` (uint8, 1 × frames × size × size; if the card has pictures) and `observation`
    (float32, 1 × features of all ticks; if it has any), output `action` (float32, 1 × 1).

    sight: required for a card with pictures

    Raise `PolicyError` if the layers do not fit one another or the card, are too large, or are not
    finite.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    kinds = {"uint8": TensorProto.UINT8, "float32": TensorProto.FLOAT}
    sight = sight or Sight([], {}, file.INPUT, card.numbers)
    nodes, constants = list(sight.nodes), dict(sight.constants)
    width = _add_layers(nodes, constants, layers, activation, sight)
    size = sum(array.nbytes for array in constants.values())
    if size > MAX_WEIGHTS_BYTES:
        remedy = "fewer units, or smaller frames" if card.pictures else "fewer units in its layers"
        raise PolicyError(
            f"the weights of this policy take {size / 2**20:.0f} MB, and "
            f"{MAX_WEIGHTS_BYTES // 2**20} are the most; train one with {remedy}"
        )
    graph = helper.make_graph(
        nodes,
        "policy",
        [
            helper.make_tensor_value_info(name, kinds[kind], dims)
            for name, kind, dims in file.network_inputs(card)
        ],
        [helper.make_tensor_value_info(file.OUTPUT, TensorProto.FLOAT, [1, width])],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    model = helper.make_model(
        graph,
        producer_name="fishd",
        producer_version=card.provenance.fishd,
        ir_version=file.IR_VERSION,
        opset_imports=[helper.make_opsetid("", OPSET)],
    )
    helper.set_model_props(model, {CARD_KEY: encode(card)})
    onnx.checker.check_model(model)
    content = file.seal(model)
    file.parse(content)
    return content


def _add_layers(
    nodes: list[Any],
    constants: dict[str, NDArray[Any]],
    layers: Sequence[Layer],
    activation: Literal["tanh", "relu"],
    sight: Sight,
) -> int:
    """Add operators and constants of the layers; return the number of outputs of the last one."""
    from onnx import helper

    if not layers:
        raise PolicyError("a policy needs at least one layer")
    value, width, last = sight.out, sight.width, len(layers) - 1
    for number, (weight, bias) in enumerate(layers):
        if number == last and sight.mirrored:
            constants["beside"] = np.array([1, 2 * width])
            nodes.append(helper.make_node("Reshape", [value, "beside"], ["both"]))
            value, width = "both", 2 * width
        if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1]:
            raise PolicyError(
                f"layer {number}: weights {weight.shape} and biases {bias.shape} do not fit "
                f"{width} inputs"
            )
        width = weight.shape[0]
        names = [f"weight_{number}", f"bias_{number}"]
        for name, array in zip(names, (weight, bias), strict=True):
            constants[name] = array.astype(np.float32)
        linear, active = f"linear_{number}", f"active_{number}"
        nodes.append(helper.make_node("Gemm", [value, *names], [linear], transB=1))
        nodes.append(helper.make_node(_OPERATORS[activation], [linear], [active]))
        value = active
    nodes[-1] = helper.make_node("Clip", [f"linear_{last}", "low", "high"], [file.OUTPUT])
    constants |= {"low": np.array(-1.0, np.float32), "high": np.array(1.0, np.float32)}
    return width
