"""Reader of policy files; refuses other files, damaged ones, and those that could run code or hang.

A policy file is an ONNX model with a card (`card.Card`) in its metadata. Messages state why a file
is refused, and the remedy.
"""

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fishd.controllers.policy.card import CARD_KEY, Card, decode
from fishd.core import files
from fishd.core.errors import PolicyError
from fishd.core.text import describe_error, error_message, quoted

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, TensorProto, ValueInfoProto

EXPORT_MODEL = "fishd.learning.export.export_model"
WRITERS = (
    "policy files are written by 'fishctl learn export' from the folder of a training, by "
    f"{EXPORT_MODEL} from a model of stable-baselines3, and by "
    "fishd.controllers.policy.network.to_onnx from weights"
)
"""The writers of policy files, for a file that cannot become one."""
INPUT, FRAMES, OUTPUT = "observation", "frames", "action"
MAX_NAMED_TENSORS = 4
"""Maximum number of inputs or outputs in a message."""
MAX_FILE_BYTES = 16 * 2**20
"""Maximum size of a file; a policy has about ten thousand weights [bytes]."""
MISSING_PACKAGE = (
    "is not installed: install fishd[policy], or onnx and onnxruntime, which have no build for "
    "32-bit ARM"
)

CHECKSUM_KEY = "fishd.sha256"
"""Key of the checksum in the metadata of an ONNX file."""
SEAL_REMEDY = "call fishd.controllers.policy.file.seal as the last step"
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
"""Operators of ONNX itself that a network may use, by purpose; each of them ends by itself."""

OPSETS = range(11, 27)
"""Supported versions of these operators."""
IR_VERSION = 7
"""Version of the format that every supported onnxruntime can read."""
MAX_NODES = 1000


_NAMES = frozenset(name for names in PERMITTED.values() for name in names)
_ONNX_DOMAINS = ("", "ai.onnx")
_HIDDEN_FOLDERS = ("/home/", "/root/", "/run/user/")
"""Folders that systemd's ProtectHome= hides from a service."""


class PolicyFile(NamedTuple):
    """A valid policy file; whether it fits a robot is checked separately."""

    path: Path
    content: bytes
    card: Card


def read(path: Path) -> PolicyFile:
    """Return the policy in a file; raise `PolicyError` with its name."""
    try:
        content = files.read(path, MAX_FILE_BYTES, "a policy")
        return PolicyFile(path, content, parse(content))
    except files.NoFile as problem:
        raise PolicyError(f"{path}: {problem}{_why_hidden(path)}") from None
    except (files.FileProblem, PolicyError) as problem:
        raise PolicyError(f"{path}: {problem}") from None


def parse(content: bytes) -> Card:
    """Check the content of a policy file and return its card; raise `PolicyError`."""
    _refuse_pickles(content)
    model = _load_model(content)
    try:
        return _check_model(content, model)
    except (AttributeError, TypeError, UnicodeError):  # text that is not UTF-8 is bytes in onnx
        raise PolicyError(f"this is not a complete ONNX model; {WRITERS}") from None


def _check_model(content: bytes, model: "ModelProto") -> Card:
    text = _card_text(model)
    checksums = [entry.value for entry in model.metadata_props if entry.key == CHECKSUM_KEY]
    # Before the card, since damage may have changed that.
    if checksums and checksums != [_digest(content, checksums[0])]:
        raise PolicyError(
            "it is damaged: its content does not match its checksum; copy it again; in a program "
            f"that changes it, {SEAL_REMEDY}"
        )
    card = decode(text)
    if not checksums:
        raise PolicyError(
            f"its metadata lacks {CHECKSUM_KEY}, the checksum; in the program that made the file, "
            f"{SEAL_REMEDY}"
        )
    _check_values("inputs", _inputs(model.graph), network_inputs(card))
    _check_values("outputs", model.graph.output, [(OUTPUT, "float32", (1, 1))])
    _check_numbers(model.graph)
    check_operators(model)
    return card


def seal(model: "ModelProto") -> bytes:
    """Return the file of a model with its checksum, which replaces an existing one."""
    kept = [(entry.key, entry.value) for entry in model.metadata_props if entry.key != CHECKSUM_KEY]
    del model.metadata_props[:]
    for key, value in kept:
        model.metadata_props.add(key=key, value=value)
    # A placeholder that does not occur in the model.
    placeholder = hashlib.sha256(model.SerializeToString()).hexdigest()
    model.metadata_props.add(key=CHECKSUM_KEY, value=placeholder)
    content: bytes = model.SerializeToString()
    return content.replace(placeholder.encode(), _digest(content, placeholder).encode())


def _digest(content: bytes, checksum: str) -> str:
    """Return the hexadecimal SHA-256 of a file with zeros in place of its checksum."""
    encoded = checksum.encode()
    if content.count(encoded) != 1:
        return ""
    return hashlib.sha256(content.replace(encoded, b"0" * 64)).hexdigest()


def _why_hidden(path: Path) -> str:
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if not (state and str(path).startswith(_HIDDEN_FOLDERS)):
        return ""
    return (
        ": this fishd is a service without access to home folders; put the file into "
        f"{state}/policies "
        "and give its name"
    )


def _refuse_pickles(content: bytes) -> None:
    if content.startswith(b"\x80"):
        raise PolicyError(f"this is a pickle, which could run any code; {WRITERS}")
    if content.startswith(b"PK") and b"_stable_baselines3_version" in content:
        raise PolicyError(
            "this is a model of stable-baselines3, with pickles, which could run any code: load it "
            f"with env=gymnasium.make('fishd/Swim-v0'), and write it with {EXPORT_MODEL}"
        )
    if content.startswith(b"PK"):
        raise PolicyError(
            "this is a zip archive as torch writes, with a pickle, which could run any code; "
            f"{WRITERS}"
        )


def _load_model(content: bytes) -> "ModelProto":
    try:
        import onnx
    except ImportError:
        raise PolicyError(f"it cannot be checked: onnx {MISSING_PACKAGE}") from None
    try:
        model = onnx.load_model_from_string(content)
    except Exception:  # protobuf has its own error classes
        model = None
    # Almost any bytes are a valid protobuf message with unknown fields.
    if model is None or not (model.ir_version and model.opset_import and model.graph.node):
        raise PolicyError(f"this is not an ONNX model; {WRITERS}")
    return model


def _card_text(model: "ModelProto") -> str:
    cards = [entry.value for entry in model.metadata_props if entry.key == CARD_KEY]
    if not cards:
        inputs, outputs = _format_forms(_inputs(model.graph)), _format_forms(model.graph.output)
        raise PolicyError(
            "this ONNX file does not contain the observation, tick and Φ of its training: its "
            f"metadata lacks {CARD_KEY}. Its inputs: {inputs}; its outputs: {outputs}. Write a "
            f"model of stable-baselines3 with {EXPORT_MODEL}; for any other, name the input "
            f"'{INPUT}' and the output '{OUTPUT}', float32 of shapes [1, N] and [1, 1], add the "
            f"card, and {SEAL_REMEDY}"
        )
    if len(cards) > 1:
        raise PolicyError(
            f"its metadata has {len(cards)} entries {CARD_KEY}, which may contradict one another; "
            f"keep one, and {SEAL_REMEDY}"
        )
    return str(cards[0])


def _inputs(graph: "GraphProto") -> "list[ValueInfoProto]":
    """Return the inputs of a network; older files list the weights, too."""
    weights = {tensor.name for tensor in graph.initializer}
    return [value for value in graph.input if value.name not in weights]


_TensorForm = tuple[str, str, tuple[int | str, ...]]
"""Name, type and dimensions of a tensor; an open dimension is its name, or `?`."""


def network_inputs(card: Card) -> list[_TensorForm]:
    """Return the inputs of the network of a policy: frames if it uses any, then other numbers."""
    inputs: list[_TensorForm] = []
    if card.pictures:
        inputs.append((FRAMES, "uint8", (1, *card.pictures.shape)))
    if card.observation:
        inputs.append((INPUT, "float32", (1, card.numbers)))
    return inputs


def _check_values(
    what: str, values: "Sequence[ValueInfoProto]", required: list[_TensorForm]
) -> None:
    forms = [_tensor_form(value) for value in values]
    if len(forms) == len(required) and set(forms) == set(required):
        return
    needed = " and ".join(
        f"one {kind} {what[:-1]} of shape [{', '.join(map(str, dims))}] named '{name}'"
        for name, kind, dims in required
    )
    verb = "is" if len(required) == 1 else "are"
    raise PolicyError(
        f"its {what}: {_format_forms(values)}; {needed} {verb} needed: change them in the program "
        f"that made the file, and {SEAL_REMEDY}"
    )


def _format_forms(values: "Sequence[ValueInfoProto]") -> str:
    """Format inputs or outputs, of many only the first."""
    forms = [_format_form(_tensor_form(value)) for value in values[:MAX_NAMED_TENSORS]]
    rest = len(values) - len(forms)
    return ", ".join(forms + [f"{rest} more"] * (rest > 0)) or "none"


def _tensor_form(value: "ValueInfoProto") -> _TensorForm:
    from onnx import TensorProto

    tensor = value.type.tensor_type
    try:
        kind = TensorProto.DataType.Name(tensor.elem_type).lower()
    except ValueError:
        kind = "unknown"
    dims = tuple(
        int(dim.dim_value) if dim.HasField("dim_value") else dim.dim_param or "?"
        for dim in tensor.shape.dim
    )
    return value.name, "float32" if kind == "float" else kind, dims


def _format_form(form: _TensorForm) -> str:
    name, kind, dims = form
    return f"{kind} of shape [{quoted(', '.join(map(str, dims)))}] named '{quoted(name)}'"


def _check_numbers(graph: "GraphProto") -> None:
    """Check that every number of the model is in this file and finite."""
    if graph.sparse_initializer:
        raise PolicyError(f"its weights are sparse; save them as plain ones, and {SEAL_REMEDY}")
    for node in graph.node:
        for attribute in node.attribute:
            if not np.isfinite([attribute.f, *attribute.floats]).all():
                name = node.name or node.op_type
                raise _not_finite(f"'{quoted(attribute.name)}' of '{quoted(name)}'")
    for tensor in _tensors(graph):
        _check_tensor(tensor)


def _tensors(graph: "GraphProto") -> "Iterator[TensorProto]":
    """Yield the weights of a network, and the constants of its operators."""
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors


def _check_tensor(tensor: "TensorProto") -> None:
    from onnx import TensorProto, numpy_helper

    what = f"weights '{quoted(tensor.name)}'" if tensor.name else "constants"
    if tensor.data_location == TensorProto.EXTERNAL or tensor.external_data:
        raise PolicyError(
            f"its {what} are in another file; save the model as a single file (torch.onnx.export: "
            f"external_data=False), and {SEAL_REMEDY}"
        )
    try:
        array = numpy_helper.to_array(tensor)
        numbers = array if array.dtype.kind in "biufc" else array.astype(np.float32)
    except Exception as error:  # a tensor may be inconsistent in many ways
        raise PolicyError(f"its {what} cannot be read: {describe_error(error)}") from None
    if not np.isfinite(numbers).all():
        raise _not_finite(what)


def _not_finite(what: str) -> PolicyError:
    return PolicyError(
        f"its {what} are not all finite numbers: the training diverged; export an earlier "
        "checkpoint"
    )


def check_operators(model: "ModelProto") -> None:
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
