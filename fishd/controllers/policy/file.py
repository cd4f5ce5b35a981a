"""Reader of policy files; refuses other files, damaged ones, and those that could run code or hang.

A policy file is an ONNX model with a card (`card.Card`) in its metadata. Messages state why a file
is refused, and the remedy.
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fishd.controllers.policy import checksum, operators
from fishd.controllers.policy.card import CARD_KEY, Card, decode
from fishd.core import files
from fishd.core.errors import PolicyError
from fishd.core.text import describe_error, quoted

if TYPE_CHECKING:
    from onnx import GraphProto, ModelProto, TensorProto, ValueInfoProto

EXPORT_REMEDY = "export it with 'fishctl learn export'"
INPUT, FRAMES, OUTPUT = "observation", "frames", "action"
MAX_FILE_BYTES = 16 * 2**20
"""Maximum size of a file; a policy has about ten thousand weights [bytes]."""
MISSING_PACKAGE = (
    "is not installed: install fishd[policy], or onnx and onnxruntime, which have no build for "
    "32-bit ARM"
)

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
        raise PolicyError(f"this is not a complete ONNX model; {EXPORT_REMEDY}") from None


def _check_model(content: bytes, model: "ModelProto") -> Card:
    text = _card_text(model)
    if checksum.has_checksum(model):  # first, for the right error about a damaged card
        checksum.check(content, model)
    card = decode(text)
    checksum.check(content, model)
    _check_ends(model.graph, card)
    _check_numbers(model.graph)
    operators.check(model)
    return card


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
        raise PolicyError(f"this is a pickle, which could run any code; {EXPORT_REMEDY}")
    if content.startswith(b"PK"):
        raise PolicyError(
            "this is a zip archive as torch writes, with a pickle, which could run any code; "
            f"{EXPORT_REMEDY}"
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
        raise PolicyError(f"this is not an ONNX model; {EXPORT_REMEDY}")
    return model


def _card_text(model: "ModelProto") -> str:
    cards = [entry.value for entry in model.metadata_props if entry.key == CARD_KEY]
    if not cards:
        raise PolicyError(
            "this ONNX file does not contain the observation, tick and Φ of its training: its "
            f"metadata lacks {CARD_KEY}; {EXPORT_REMEDY}"
        )
    if len(cards) > 1:
        raise PolicyError(f"it has {len(cards)} cards that may contradict one another")
    return str(cards[0])


def _check_ends(graph: "GraphProto", card: Card) -> None:
    weights = {tensor.name for tensor in graph.initializer}
    inputs = [value for value in graph.input if value.name not in weights]
    _check_values("inputs", inputs, network_inputs(card))
    _check_values("outputs", list(graph.output), [(OUTPUT, "float32", (1, 1))])


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


def _check_values(what: str, values: "list[ValueInfoProto]", required: list[_TensorForm]) -> None:
    forms = [_tensor_form(value) for value in values]
    if len(forms) == len(required) and set(forms) == set(required):
        return
    actual = ", ".join(map(_format_form, forms)) or "none"
    needed = " and ".join(
        f"one {kind} {what[:-1]} of shape [{', '.join(map(str, dims))}] named '{name}'"
        for name, kind, dims in required
    )
    verb = "is" if len(required) == 1 else "are"
    raise PolicyError(f"its {what}: {actual}; {needed} {verb} needed; {EXPORT_REMEDY}")


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
    for tensor in graph.initializer:
        _check_tensor(tensor)
    if graph.sparse_initializer:
        raise PolicyError("its weights are sparse; save them as plain ones")
    for node in graph.node:
        for attribute in node.attribute:
            if not np.isfinite([attribute.f, *attribute.floats]).all():
                raise PolicyError(
                    _not_finite(
                        f"'{quoted(attribute.name)}' of '{quoted(node.name or node.op_type)}'"
                    )
                )
            for tensor in (attribute.t, *attribute.tensors):
                _check_tensor(tensor)
            if attribute.HasField("sparse_tensor") or attribute.sparse_tensors:
                raise PolicyError("its constants are sparse; save them as plain ones")


def _check_tensor(tensor: "TensorProto") -> None:
    from onnx import TensorProto, numpy_helper

    what = f"weights '{quoted(tensor.name)}'" if tensor.name else "constants"
    if tensor.data_location == TensorProto.EXTERNAL or tensor.external_data:
        raise PolicyError(f"its {what} are in another file; save the model as a single file")
    if tensor.data_type == TensorProto.UNDEFINED:  # an attribute without a tensor
        return
    try:
        array = numpy_helper.to_array(tensor)
        numbers = array if array.dtype.kind in "biufc" else array.astype(np.float32)
    except Exception as error:  # a tensor may be inconsistent in many ways
        raise PolicyError(f"its {what} cannot be read: {describe_error(error)}") from None
    if not np.isfinite(numbers).all():
        raise PolicyError(_not_finite(what))


def _not_finite(what: str) -> str:
    return (
        f"its {what} are not all finite numbers: the training diverged; export an earlier "
        "checkpoint"
    )
