"""The channels of a recording, and their JSON Schemas, which viewers read.

Viewers want a root of type object, no `$ref` and no `anyOf`, so what is nested stays a bare object.
"""

from typing import Any

import msgspec
from msgspec import Struct

from fishd.core.schema import fields_of
from fishd.core.signals import Event, Status, Tick

CHANNELS: dict[str, type[Struct]] = {"tick": Tick, "event": Event, "status": Status}
"""What is recorded: topics of telemetry, and what their messages are."""

_TYPES = {
    "number": "number",
    "integer": "integer",
    "boolean": "boolean",
    "section": "object",
    "list": "array",
}


def schema_name(message: type[Struct]) -> str:
    """The name of the schema in the file, such as `fishd.Tick`."""
    return f"fishd.{message.__name__}"


def json_schema(message: type[Struct]) -> bytes:
    """The JSON Schema of a message, flat."""
    properties: dict[str, Any] = {}
    for field in fields_of(message):
        described = f"{field.description} [{field.unit}]" if field.unit else field.description
        properties[field.name] = {
            "type": _TYPES.get(field.kind, "string"),
            "description": described,
        }
    title = schema_name(message)
    return msgspec.json.encode({"title": title, "type": "object", "properties": properties})
