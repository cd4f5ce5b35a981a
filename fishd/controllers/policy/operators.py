"""Operators that the network of a policy may use; all of them run in bounded time.

Time and memory of each follow from the shapes, and both are bounded before onnxruntime loads the
model.
"""

from collections.abc import Mapping
from math import prod
from typing import TYPE_CHECKING

from fishd.core.errors import PolicyError
from fishd.core.text import error_message, quoted

if TYPE_CHECKING:
    from onnx import ModelProto, NodeProto, ValueInfoProto

PERMITTED: Mapping[str, tuple[str, ...]] = {
    "layers": ("Gemm", "MatMul", "Conv", "BatchNormalization", "LayerNormalization"),
    "activations": (
        *("Celu", "Clip", "Elu", "Erf", "Gelu", "HardSigmoid", "HardSwish", "LeakyRelu"),
        *("LogSoftmax", "Mish", "PRelu", "Relu", "Selu", "Sigmoid", "Softmax", "Softplus"),
        *("Softsign", "Tanh", "ThresholdedRelu"),
    ),
    "arithmetic": (
        *("Abs", "Add", "Ceil", "Cos", "Div", "Exp", "Floor", "Log", "Max", "Mean", "Min"),
        *("Mul", "Neg", "Pow", "Reciprocal", "Round", "Sign", "Sin", "Sqrt", "Sub", "Sum"),
    ),
    "sums": ("ArgMax", "GlobalAveragePool", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum"),
    "choices": (
        *("And", "Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "Not", "Or"),
        "Where",
    ),
    "shapes": (
        *("Cast", "Concat", "Constant", "ConstantOfShape", "Expand", "Flatten", "Gather"),
        *("Identity", "Reshape", "Shape", "Slice", "Split", "Squeeze", "Transpose", "Unsqueeze"),
    ),
}
"""Operators of ONNX itself, by purpose."""

OPSETS = range(11, 27)
"""Supported versions of these operators."""
MAX_NODES = 1000
MAX_VALUES = 4 * 2**20
"""Maximum number of outputs of all operators together in one run."""
MAX_MULTIPLICATIONS = 10**8
"""Maximum number of multiplications in one run, approximately: 0.1 s on a slow robot."""

_NAMES = frozenset(name for names in PERMITTED.values() for name in names)
_ONNX_DOMAINS = ("", "ai.onnx")
_COUNT_ATTRIBUTES = ("dilations", "group", "kernel_shape", "strides")
"""Attributes that must not be 0, since operators divide by them."""

Shapes = Mapping[str, tuple[int, ...] | None]
"""Shape of each value in a model; None if it is open."""


def check(model: "ModelProto") -> None:
    """Raise `PolicyError` for a model with other operators, or with too much computation."""
    if model.functions:
        raise PolicyError(f"it defines a custom operator, {quoted(model.functions[0].name)}")
    if model.training_info:
        raise PolicyError("it is a model that trains itself; export it for inference")
    versions = [entry.version for entry in model.opset_import if entry.domain in _ONNX_DOMAINS]
    if len(versions) != 1 or versions[0] not in OPSETS:
        version_list = ", ".join(map(str, versions)) or "none"
        raise PolicyError(
            f"its version of ONNX's operators: {version_list}; one from {OPSETS[0]} to "
            f"{OPSETS[-1]} is "
            "needed"
        )
    nodes = model.graph.node
    if len(nodes) > MAX_NODES:
        raise PolicyError(f"it has {len(nodes)} operators; {MAX_NODES} are the most")
    for node in nodes:
        _check_node(node)
    _check_size(model)


def _check_node(node: "NodeProto") -> None:
    if node.domain not in _ONNX_DOMAINS or node.op_type not in _NAMES:
        name = f"{node.domain}.{node.op_type}" if node.domain not in _ONNX_DOMAINS else node.op_type
        raise PolicyError(
            f"its operator {quoted(name)} is not permitted; permitted: {', '.join(sorted(_NAMES))}"
        )
    for attribute in node.attribute:
        if attribute.HasField("g") or attribute.graphs:
            raise PolicyError(f"its {node.op_type} contains a graph")
        counts = [attribute.i] if attribute.type == attribute.INT else attribute.ints
        if attribute.name in _COUNT_ATTRIBUTES and min(counts, default=0) < 1:
            raise PolicyError(
                f"its {node.op_type}: {attribute.name} {list(counts)}: 1 or more is needed"
            )


def _check_size(model: "ModelProto") -> None:
    """Bound computation and memory of one run, from the shape of every value."""
    shapes = _infer_shapes(model)
    values = work = 0
    for node in model.graph.node:
        output_shapes = [shapes.get(name) for name in node.output if name]
        input_shapes = [shapes.get(name) for name in node.input if name]
        if None in output_shapes or None in input_shapes:
            raise PolicyError(
                f"the shapes of its {node.op_type} are not fixed, so its cost is unknown "
                "before it runs; export it with fixed shapes"
            )
        out = sum(prod(shape) for shape in output_shapes if shape is not None)
        sizes = [shape for shape in input_shapes if shape is not None]
        values += out
        work += out * _factor(node, sizes) or max(out, sum(map(prod, sizes)))
    for what, count, limit in (
        ("values", values, MAX_VALUES),
        ("multiplications", work, MAX_MULTIPLICATIONS),
    ):
        if count > limit:
            raise PolicyError(
                f"its network computes {count:.2g} {what} for one answer; {limit:.2g} are the "
                "most, and a policy needs some ten thousand"
            )


def _factor(node: "NodeProto", taken: list[tuple[int, ...]]) -> int:
    """Return the multiplications per output; 0 if a node reads each input once."""
    if node.op_type in ("Gemm", "MatMul"):
        return max(taken[0], default=1)
    return prod(taken[1][1:]) if node.op_type == "Conv" else 0


def _infer_shapes(model: "ModelProto") -> Shapes:
    """Return shapes inferred from inputs and weights; stated shapes in the model are ignored."""
    import onnx
    from onnx import TensorProto

    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    del bare.graph.value_info[:]
    try:
        graph = onnx.shape_inference.infer_shapes(bare, strict_mode=True, data_prop=True).graph
    except Exception as error:  # onnx's and protobuf's errors, and ValueError
        raise PolicyError(f"its network contradicts itself: {error_message(error)}") from None
    shapes: dict[str, tuple[int, ...] | None] = {
        tensor.name: tuple(tensor.dims) for tensor in graph.initializer
    }
    given = [name for node in graph.node for name in node.output if name]
    if len(set(given)) < len(given) or not shapes.keys().isdisjoint(given):
        raise PolicyError("its network contradicts itself: two values have one name")
    for value in (*graph.input, *graph.value_info, *graph.output):
        if value.type.tensor_type.elem_type == TensorProto.STRING:
            raise PolicyError(f"its {quoted(value.name)} is text; a network computes numbers")
        shapes.setdefault(value.name, _shape(value))
    return shapes


def _shape(value: "ValueInfoProto") -> tuple[int, ...] | None:
    tensor = value.type.tensor_type
    if not tensor.HasField("shape") or any(not d.HasField("dim_value") for d in tensor.shape.dim):
        return None
    return tuple(int(dim.dim_value) for dim in tensor.shape.dim)
