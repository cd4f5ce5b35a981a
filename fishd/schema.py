"""One source for everything that is said about parameters.

Configuration sections and controller parameters are msgspec structs whose fields carry bounds, unit
and description. From those this module takes validation with readable errors (`convert`) and a
description (`fields_of`) that help texts, command-line options and documentation are made from.
"""

import difflib
import re
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar, cast

import msgspec
from msgspec import Struct, inspect

T = TypeVar("T")

Scalar = bool | int | float | str | None


class Field(Struct, frozen=True):
    """One field of a struct, as a person or an option parser wants to know it."""

    name: str
    kind: str
    """number, integer, text, boolean, choice or section"""
    unit: str
    description: str
    default: Scalar
    interval: str
    """Permitted values: an interval such as `(0, 2]`, or choices such as `a | b`; empty for any."""
    optional: bool
    """True where null is permitted."""


class Problem(Exception):
    """A value that does not fit; `path` holds the keys that lead to it."""

    def __init__(self, path: tuple[str, ...], message: str) -> None:
        super().__init__(message)
        self.path = path


_KINDS: dict[type[inspect.Type], str] = {
    inspect.FloatType: "number",
    inspect.IntType: "integer",
    inspect.StrType: "text",
    inspect.BoolType: "boolean",
    inspect.LiteralType: "choice",
    inspect.StructType: "section",
    inspect.DictType: "section",
}


def fields_of(struct: type[Struct]) -> tuple[Field, ...]:
    """The fields of a parameter struct, in the order in which they are declared."""
    info = cast(inspect.StructType, inspect.type_info(struct))
    return tuple(_describe(field) for field in info.fields)


def convert(data: Any, target: type[T], *, prefix: tuple[str, ...] = ()) -> T:
    """Validate `data` into the struct `target`.

    Raises `Problem`, whose message names the permitted values or the nearest valid key and whose
    path begins with `prefix`.
    """
    try:
        return msgspec.convert(data, target)
    except msgspec.ValidationError as error:
        path, message = _explain(error, data, cast(type[Struct], target))
        raise Problem(prefix + path, message) from None


def nearest(word: str, words: list[str]) -> str:
    """A did-you-mean for `word`, or the list of what there is."""
    close = difflib.get_close_matches(word, words, n=1, cutoff=0.6)
    if not close:  # 'noise' for 'simulation.noise'
        close = [known for known in words if known.rpartition(".")[2] == word]
    if close:
        return f"did you mean '{close[0]}'?"
    return f"valid: {', '.join(words)}" if words else "none is valid here"


def leaves(struct: type[Struct], prefix: str = "") -> list[str]:
    """Every key of `struct` and its sections in dotted form."""
    keys = [prefix + field.name for field in fields_of(struct)]
    for name, section in _sections(struct):
        keys += leaves(section, f"{prefix}{name}.")
    return keys


def _describe(field: inspect.Field) -> Field:
    about, unit, kind, optional = "", "", field.type, False
    if isinstance(kind, inspect.Metadata):
        about = (kind.extra_json_schema or {}).get("description", "")
        unit = (kind.extra or {}).get("unit", "")
        kind = kind.type
    if isinstance(kind, inspect.UnionType):
        optional = True
        kind = next(part for part in kind.types if not isinstance(part, inspect.NoneType))
    default = field.default if isinstance(field.default, Scalar) else None
    return Field(
        name=field.encode_name,
        kind=_KINDS.get(type(kind), "text"),
        unit=unit,
        description=about,
        default=default,
        interval=_interval(kind),
        optional=optional,
    )


def _interval(kind: inspect.Type) -> str:
    if isinstance(kind, inspect.LiteralType):
        return " | ".join(str(value) for value in kind.values)
    if not isinstance(kind, inspect.FloatType | inspect.IntType):
        return ""
    low = f"({kind.gt:g}" if kind.gt is not None else f"[{kind.ge:g}" if kind.ge is not None else ""
    high = (
        f"{kind.lt:g})" if kind.lt is not None else f"{kind.le:g}]" if kind.le is not None else ""
    )
    return f"{low or '(-inf'}, {high or 'inf)'}" if low or high else ""


def _explain(
    error: msgspec.ValidationError, data: Any, target: type[Struct]
) -> tuple[tuple[str, ...], str]:
    """Turn msgspec's first complaint into a path and one readable sentence."""
    text = str(error)
    complaint, _, where = text.partition(" - at `$")
    path = tuple(re.findall(r"[^.\[\]`]+", where))
    unknown = re.search(r"unknown field `(.*)`", complaint)
    if unknown:
        key = unknown.group(1)
        valid = [field.name for field in fields_of(_struct_at(target, path))]
        dotted = ".".join(path)
        everywhere = [dotted + "." + name if dotted else name for name in valid] + leaves(target)
        hint = nearest(key, valid)
        if not hint.startswith("did"):
            elsewhere = nearest(key, everywhere)
            hint = elsewhere if elsewhere.startswith("did") else hint
        return (*path, key), f"unknown key; {hint}"
    missing = re.search(r"missing required field `(.*)`", complaint)
    if missing:
        key = missing.group(1)
        return (*path, key), f"is missing: {_wanted(target, (*path, key))}"
    value = data
    for key in path:
        value = value[key] if isinstance(value, Mapping) else value
    return path, f"{_shown(value)} is not valid: {_wanted(target, path)}"


def _struct_at(target: type[Struct], path: tuple[str, ...]) -> type[Struct]:
    for key in path:
        target = next(part for name, part in _sections(target) if name == key)
    return target


def _sections(target: type[Struct]) -> Iterator[tuple[str, type[Struct]]]:
    """The fields of a struct that are structs themselves."""
    for field in cast(inspect.StructType, inspect.type_info(target)).fields:
        kind = field.type.type if isinstance(field.type, inspect.Metadata) else field.type
        if isinstance(kind, inspect.StructType):
            yield field.name, kind.cls


def _wanted(target: type[Struct], path: tuple[str, ...]) -> str:
    if not path:
        return "a mapping of keys to values is needed"
    field = next(f for f in fields_of(_struct_at(target, path[:-1])) if f.name == path[-1])
    article = {
        "number": "a number",
        "integer": "a whole number",
        "text": "a text",
        "boolean": "true or false",
        "choice": "one",
        "section": "a section (a mapping of keys to values)",
    }[field.kind]
    preposition = "of" if field.kind == "choice" else "in"
    within = f" {preposition} {field.interval}" if field.interval else ""
    unit = f" {field.unit}" if field.unit not in ("", "1") else ""
    return f"{article}{within}{unit} is needed" + (" (or null)" if field.optional else "")


def _shown(value: Any) -> str:
    text = {True: "true", False: "false", None: "null"}.get(value) if _is_word(value) else None
    text = text or repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _is_word(value: Any) -> bool:
    return value is None or isinstance(value, bool)
