"""Checksum of a policy file, which refuses a file with a changed byte."""

import hashlib
from typing import TYPE_CHECKING

from fishd.core.errors import PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto

CHECKSUM_KEY = "fishd.sha256"
"""Key of the checksum in the metadata of an ONNX file."""
SEAL_REMEDY = "call fishd.controllers.policy.checksum.seal as the last step"

_BLANK = "0" * 64


def seal(model: "ModelProto") -> bytes:
    """Return the file of a model with its checksum, which replaces an existing one."""
    kept = [(entry.key, entry.value) for entry in model.metadata_props if entry.key != CHECKSUM_KEY]
    del model.metadata_props[:]
    for key, value in kept:
        model.metadata_props.add(key=key, value=value)
    placeholder = hashlib.sha256(
        model.SerializeToString()
    ).hexdigest()  # a placeholder that does not occur in the model
    model.metadata_props.add(key=CHECKSUM_KEY, value=placeholder)
    content: bytes = model.SerializeToString()
    return content.replace(placeholder.encode(), _digest(content, placeholder).encode())


def check(content: bytes, model: "ModelProto") -> None:
    """Raise `PolicyError` unless the content of a file matches its checksum."""
    checksums = [entry.value for entry in model.metadata_props if entry.key == CHECKSUM_KEY]
    if not checksums:
        raise PolicyError(
            f"its metadata lacks {CHECKSUM_KEY}, the checksum; in the program that made the file, "
            f"{SEAL_REMEDY}"
        )
    if (
        len(checksums) > 1
        or len(checksums[0]) != len(_BLANK)
        or checksums[0] != _digest(content, checksums[0])
    ):
        raise PolicyError(
            "it is damaged: its content does not match its checksum; copy it again; in a program "
            f"that changes it, {SEAL_REMEDY}"
        )


def has_checksum(model: "ModelProto") -> bool:
    """Return whether the model has a checksum."""
    return any(entry.key == CHECKSUM_KEY for entry in model.metadata_props)


def _digest(content: bytes, checksum: str) -> str:
    """Return the hexadecimal SHA-256 of the file with zeros in place of its checksum."""
    encoded = checksum.encode()
    if content.count(encoded) != 1:
        return ""
    return hashlib.sha256(content.replace(encoded, _BLANK.encode())).hexdigest()
