"""Writer of the tables of messages, operations, events, faults and tracks in docs/.

`tools/protocol_reference.py --write` writes them into the documents; `--check` exits with 1 where
one is out of date.
"""

import sys
from collections.abc import Iterator

import msgspec
from msgspec import NODEFAULT, Struct, inspect

from common.report import table, write_reference
from fishd.camera import messages
from fishd.control.faults import FAULTS
from fishd.core import protocol, signals
from fishd.core.schema import fields_of, format_permitted
from fishd.virtual.swimmer.track import COLUMNS

TYPES = {
    inspect.FloatType: "float",
    inspect.IntType: "integer",
    inspect.StrType: "string",
    inspect.BoolType: "boolean",
    inspect.NoneType: "null",
    inspect.DictType: "object",
    inspect.LiteralType: "string",
    inspect.StructType: "object",
    inspect.TupleType: "pair",
    inspect.RawType: "any",
    inspect.AnyType: "any",
}
STRUCTS: dict[str, type[Struct]] = {
    "tick": signals.Tick,
    "event": signals.Event,
    "status": signals.Status,
    "reading": signals.ReadingState,
    "reason": signals.Reason,
    "timing": signals.Timing,
    "distribution": signals.Percentiles,
    "request": protocol.Request,
    "reply": protocol.Reply,
    "state": protocol.State,
    "lease": protocol.Grant,
    "lease holder": signals.LeaseHolder,
    "calibrations": protocol.Calibrations,
    "frame": messages.FrameHeader,
    "view": messages.ViewHeader,
    "tail": messages.TailMessage,
    "camera-state": messages.CameraState,
    "until": messages.Until,
}
"""Structs by the name of their markers."""
LIKE: dict[str, tuple[str, type[Struct]]] = {
    "status": ("tick", signals.Tick),
    "state": ("status", signals.Status),
    **dict.fromkeys(("view", "tail", "camera-state", "until"), ("frame", messages.FrameHeader)),
}
"""Tables that omit the fields of another table, with its name and struct."""


def references() -> Iterator[tuple[str, str, str]]:
    """Yield documents, names of markers, and the tables between them."""
    for name, struct in STRUCTS.items():
        yield "reference/protocol.md", name, _fields(struct, *LIKE.get(name, ("", Struct)))
    conditions = [[f"`{name}`", meaning] for name, meaning in messages.CONDITIONS.items()]
    yield "reference/protocol.md", "conditions", table("state | what it means", conditions)
    kinds = [[f"`{kind}`", *cells] for kind, *cells in signals.EVENTS]
    yield "reference/protocol.md", "kinds", table("kind | level | when | `data`", kinds)
    operations = [
        [f"`{name}`", _arguments(operation.arguments), operation.does, operation.result]
        for name, operation in protocol.OPERATIONS.items()
    ]
    head = "op | arguments | what it does | result"
    yield "reference/protocol.md", "operations", table(head, operations)
    codes = [f"[`{code}`](../how-to/troubleshooting.md#{code})" for code in FAULTS]
    yield "explanation/concepts.md", "faults", ",\n".join(codes)
    columns = [
        [f"`{name}`", "–" if unit == "1" else unit, about]
        for name, (unit, about) in COLUMNS.items()
    ]
    yield "explanation/swimmer.md", "columns", table("column | unit | meaning", columns)


def _fields(struct: type[Struct], other_name: str, other: type[Struct]) -> str:
    types = {field.encode_name: field.type for field in _info(struct)}
    like = f"as in `{other_name}`"
    known = {(f.name, text) for f in fields_of(other) for text in (f.description, f"A{like[1:]}.")}
    same = [f for f in fields_of(struct) if (f.name, f.description) in known]
    rows = [
        [
            f"`{field.name}`",
            _type(types[field.name]) + (f" [{field.unit}]" if field.unit not in ("", "1") else ""),
            field.description[:1].lower() + field.description[1:].rstrip("."),
        ]
        for field in fields_of(struct)
        if field not in same
    ]
    if same:
        rows.append([", ".join(f"`{field.name}`" for field in same), "", like])
    return table("field | type | meaning", rows)


def _arguments(struct: type[Struct]) -> str:
    limits = {field.name: format_permitted(field) for field in fields_of(struct)}
    return "; ".join(_argument(field, limits[field.name]) for field in _info(struct)) or "none"


def _argument(field: inspect.Field, limits: str) -> str:
    type_ = _type(field.type).removesuffix(" or null")
    text = f"`{field.name}`: {type_}{f' {limits}' if limits else ''}"
    if field.required:
        return text
    default = None if field.default is NODEFAULT else field.default
    return f"{text}, optional" + (
        f" (`{msgspec.json.encode(default).decode()}`)" if default else ""
    )


def _info(struct: type[Struct]) -> tuple[inspect.Field, ...]:
    info = inspect.type_info(struct)
    assert isinstance(info, inspect.StructType)
    return info.fields


def _type(kind: inspect.Type) -> str:
    if isinstance(kind, inspect.Metadata):
        return _type(kind.type)
    if isinstance(kind, inspect.UnionType):
        return " or ".join(_type(part) for part in kind.types)
    if isinstance(kind, inspect.VarTupleType):
        return f"list of {_type(kind.item_type)}s"
    return TYPES[type(kind)]


if __name__ == "__main__":
    sys.exit(write_reference("protocol_reference", references()))
