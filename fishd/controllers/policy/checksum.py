"""The checksum of a policy file: a file of which any byte was changed is refused."""

import hashlib
from typing import TYPE_CHECKING

from fishd.core.errors import PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto

CHECKSUM_KEY = "fishd.sha256"
"""Its key in the metadata of an ONNX file."""

_BLANK = "0" * 64


def seal(model: "ModelProto") -> bytes:
    """The file of a model, with its checksum, which replaces an existing one."""
    kept = [(entry.key, entry.value) for entry in model.metadata_props if entry.key != CHECKSUM_KEY]
    del model.metadata_props[:]
    for key, value in kept:
        model.metadata_props.add(key=key, value=value)
    place = hashlib.sha256(model.SerializeToString()).hexdigest()  # does not occur in it
    model.metadata_props.add(key=CHECKSUM_KEY, value=place)
    content: bytes = model.SerializeToString()
    return content.replace(place.encode(), _digest(content, place).encode())


def check(content: bytes, model: "ModelProto") -> None:
    """Raises `PolicyError` unless the content of a file fits its checksum."""
    found = [entry.value for entry in model.metadata_props if entry.key == CHECKSUM_KEY]
    if not found:
        raise PolicyError(
            f"its metadata lacks {CHECKSUM_KEY}, the checksum; export it again with 'fishctl learn "
            "export'"
        )
    if len(found) > 1 or len(found[0]) != len(_BLANK) or found[0] != _digest(content, found[0]):
        raise PolicyError(
            "it is damaged: its content does not fit its checksum; copy it here again, or export "
            "it again with 'fishctl learn export'"
        )


def has_checksum(model: "ModelProto") -> bool:
    """Does the model have a checksum?"""
    return any(entry.key == CHECKSUM_KEY for entry in model.metadata_props)


def _digest(content: bytes, checksum: str) -> str:
    """SHA-256, in hexadecimal, of the file with zeros in place of its checksum."""
    place = checksum.encode()
    if content.count(place) != 1:
        return ""
    return hashlib.sha256(content.replace(place, _BLANK.encode())).hexdigest()
