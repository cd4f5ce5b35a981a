"""Writes a policy file: a network of plain layers and its card, as one ONNX model."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fishd.controllers.policy import file
from fishd.controllers.policy.card import KEY, Card, encode
from fishd.controllers.policy.checksum import sealed
from fishd.core.errors import PolicyError

Layer = tuple[NDArray[Any], NDArray[Any]]
"""Weights, shape (outputs, inputs), and biases, shape (outputs,)."""

OPSET, IR_VERSION = 13, 7
"""Old enough for every onnxruntime that fishd runs with."""

_OPERATORS = {"tanh": "Tanh", "relu": "Relu"}


def to_onnx(layers: Sequence[Layer], activation: Literal["tanh", "relu"], card: Card) -> bytes:
    """The file: layers with the activation between them, and the last output clipped to [-1, 1].

    Input `observation` (float32, 1 × features), output `action` (float32, 1 × 1). Raises
    `PolicyError` where the layers do not fit one another or the card, or are not finite.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    if not layers:
        raise PolicyError("a policy needs at least one layer")
    nodes, weights, value, width = [], [], file.INPUT, len(card.observation)
    for number, (weight, bias) in enumerate(layers):
        if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1]:
            raise PolicyError(
                f"layer {number}: weights {weight.shape} and biases {bias.shape} do not fit "
                f"{width} inputs"
            )
        width = weight.shape[0]
        names = [f"weight_{number}", f"bias_{number}"]
        for name, array in zip(names, (weight, bias), strict=True):
            weights.append(numpy_helper.from_array(array.astype(np.float32), name))
        linear, active = f"linear_{number}", f"active_{number}"
        nodes.append(helper.make_node("Gemm", [value, *names], [linear], transB=1))
        nodes.append(helper.make_node(_OPERATORS[activation], [linear], [active]))
        value = active
    nodes[-1] = helper.make_node(
        "Clip", [f"linear_{len(layers) - 1}", "low", "high"], [file.OUTPUT]
    )
    for name, bound in (("low", -1.0), ("high", 1.0)):
        weights.append(numpy_helper.from_array(np.array(bound, np.float32), name))
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(file.INPUT, TensorProto.FLOAT, [1, len(card.observation)])],
        [helper.make_tensor_value_info(file.OUTPUT, TensorProto.FLOAT, [1, width])],
        weights,
    )
    model = helper.make_model(
        graph,
        producer_name="fishd",
        producer_version=card.provenance.fishd,
        ir_version=IR_VERSION,
        opset_imports=[helper.make_opsetid("", OPSET)],
    )
    helper.set_model_props(model, {KEY: encode(card)})
    onnx.checker.check_model(model)
    content = sealed(model)
    file.parse(content)
    return content
