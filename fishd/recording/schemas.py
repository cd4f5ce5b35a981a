"""Channels of a recording, and their JSON Schemas for viewers.

Viewers need a root of type object, without `$ref` and `anyOf`, so nested values are plain objects.
"""

from typing import Any

import msgspec
from msgspec import Struct

from fishd.core.schema import fields_of
from fishd.core.signals import Event, Status, Tick

CHANNELS: dict[str, type[Struct]] = {"tick": Tick, "event": Event, "status": Status}
"""Recorded topics of telemetry, and the types of their messages."""

_TYPES = {
    "number": "number",
    "integer": "integer",
    "boolean": "boolean",
    "section": "object",
    "list": "array",
}


def schema_name(message: type[Struct]) -> str:
    """Return the name of the schema in the file, such as `fishd.Tick`."""
    return f"fishd.{message.__name__}"


def json_schema(message: type[Struct]) -> bytes:
    """Return the flat JSON Schema of a message."""
    properties: dict[str, Any] = {}
    for field in fields_of(message):
        description = f"{field.description} [{field.unit}]" if field.unit else field.description
        properties[field.name] = {
            "type": _TYPES.get(field.kind, "string"),
            "description": description,
        }
    title = schema_name(message)
    return msgspec.json.encode({"title": title, "type": "object", "properties": properties})
