"""Operators that the network of a policy may use; each of them ends by itself."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fishd.controllers.policy.checksum import SEAL_REMEDY
from fishd.core.errors import PolicyError
from fishd.core.text import error_message, quoted

if TYPE_CHECKING:
    from onnx import ModelProto

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
IR_VERSION = 7
"""Version of the format that every supported onnxruntime can read."""
MAX_NODES = 1000

_NAMES = frozenset(name for names in PERMITTED.values() for name in names)
_ONNX_DOMAINS = ("", "ai.onnx")


def check(model: "ModelProto") -> None:
    """Raise `PolicyError` for a model with other operators, or one that contradicts itself."""
    import onnx

    if model.functions:
        raise PolicyError(
            f"it defines a custom operator, {quoted(model.functions[0].name)}; replace it by those "
            f"of ONNX with onnx.inliner.inline_local_functions, and {SEAL_REMEDY}"
        )
    if model.ir_version > onnx.IR_VERSION:
        raise PolicyError(
            f"its ir_version is {model.ir_version}; the installed onnx reads up to "
            f"{onnx.IR_VERSION}: set model.ir_version to {IR_VERSION}, and {SEAL_REMEDY}"
        )
    versions = [entry.version for entry in model.opset_import if entry.domain in _ONNX_DOMAINS]
    if len(versions) != 1 or versions[0] not in OPSETS:
        version_list = ", ".join(map(str, versions)) or "none"
        raise PolicyError(
            f"its version of ONNX's operators: {version_list}; one from {OPSETS[0]} to "
            f"{OPSETS[-1]} is needed; convert the model with "
            f"onnx.version_converter.convert_version, and {SEAL_REMEDY}"
        )
    nodes = model.graph.node
    if len(nodes) > MAX_NODES:
        raise PolicyError(f"it has {len(nodes)} operators; {MAX_NODES} are the most")
    for node in nodes:
        name = node.op_type
        if node.domain not in _ONNX_DOMAINS or name not in _NAMES:
            name = name if node.domain in _ONNX_DOMAINS else f"{node.domain}.{name}"
            permitted = ", ".join(sorted(_NAMES))
            raise PolicyError(
                f"its operator {quoted(name)} is not permitted; permitted: {permitted}"
            )
    try:
        onnx.checker.check_model(model, full_check=True)
    except Exception as error:  # onnx's and protobuf's errors, and ValueError
        raise PolicyError(
            f"its network contradicts itself: {error_message(error)}; correct it in the program "
            f"that made the file, and {SEAL_REMEDY}"
        ) from None
