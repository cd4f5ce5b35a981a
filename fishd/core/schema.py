"""One source for everything that is said about parameters.

Configuration sections and controller parameters are msgspec structs whose fields carry bounds, unit
and description. From those this module takes validation with readable errors (`convert`) and a
description (`fields_of`) that help texts, command-line options and documentation are made from.
"""

import difflib
import heapq
import re
import reprlib
import threading
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any, TypeVar, cast

import msgspec
from msgspec import Struct, inspect

from fishd import text

LONGEST_WORD = 100
"""For a longer one no suggestion is looked for [characters]."""
_CANDIDATES = 5

T = TypeVar("T")

Scalar = bool | int | float | str | None


class Field(Struct, frozen=True, omit_defaults=True):
    """One field of a struct, as a person or an option parser wants to know it."""

    name: str
    kind: str
    """number, integer, text, boolean, choice, section or list"""
    unit: str
    description: str
    default: Scalar
    interval: str
    """Permitted values: an interval such as `(0, 2]`, or choices such as `a | b`; empty for any."""
    optional: bool
    """True where null is permitted."""
    required: bool = False
    """True where there is no default."""
    file: str = ""
    """Suffix, such as `.onnx`, where a text may be the path of a file: see `names_file`."""


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
    inspect.VarTupleType: "list",
}


def without_empty_sections(data: Mapping[str, Any], target: type[Struct]) -> dict[str, Any]:
    """`data` less the sections below which nothing is written, so that they take their defaults."""
    kept = dict(data)
    for name, section in _sections(target):
        if isinstance(kept.get(name), Mapping):
            kept[name] = without_empty_sections(kept[name], section)
        elif name in kept and kept[name] is None:
            del kept[name]
    return kept


def fields_of(struct: type[Struct]) -> tuple[Field, ...]:
    """The fields of a parameter struct, in the order in which they are declared."""
    return _fields_of(struct)


@lru_cache(maxsize=256)  # controllers are asked for theirs in every request
def _fields_of(struct: type[Struct]) -> tuple[Field, ...]:
    return tuple(_describe(field) for field in _info(struct).fields)


@lru_cache(maxsize=256)
def _info(struct: type[Struct]) -> inspect.StructType:
    return cast(inspect.StructType, inspect.type_info(struct))


def convert(data: Any, target: type[T], *, prefix: tuple[str, ...] = ()) -> T:
    """Validate `data` into the struct `target`.

    Raises `Problem`, whose message names the permitted values or the nearest valid key and whose
    path begins with `prefix`.
    """
    _prepare(target)
    try:
        return msgspec.convert(data, target)
    except msgspec.ValidationError as error:
        path, message = _explain(error, data, cast(type[Struct], target))
        raise Problem(prefix + path, message) from None


_prepared: set[Any] = set()
_preparing = threading.Lock()


def _prepare(target: Any) -> None:
    """Let msgspec look at a type for the first time in one thread only: in two, it crashes."""
    if target in _prepared:
        return
    with _preparing:
        msgspec.json.Decoder(target)
        _prepared.add(target)


def wanted(field: Field) -> str:
    """What a field takes, in words: `a number in [0, 1] rad (or null)`."""
    if field.file:
        return f"a name or the path of a *{field.file} file" + (" (or null)" * field.optional)
    kind = {
        "number": "a number",
        "integer": "a whole number",
        "text": "a text",
        "boolean": "true or false",
        "choice": "one of",
        "section": "a section (a mapping of keys to values)",
        "list": "a list",
    }[field.kind]
    preposition = {"choice": "", "text": "of ", "list": "of "}.get(field.kind, "in ")
    within = preposition + field.interval
    unit = "" if field.unit in ("", "1") else field.unit
    words = " ".join(word for word in (kind, within if field.interval else "", unit) if word)
    return words + (" (or null)" if field.optional else "")


def names_file(text: str, suffix: str) -> bool:
    """Is a text that may be the name of something, or the path of a file, the latter?"""
    return "/" in text or text.endswith(suffix)


def nested_too_deeply(data: Any, levels: int = 20) -> bool:
    """Are there more than so many lists and mappings in one another?

    Whoever walks through them, such as an encoder, would reach the end of Python's stack.
    """
    if isinstance(data, Mapping):
        data = list(data.values())
    if not isinstance(data, list):
        return False
    return levels == 0 or any(nested_too_deeply(part, levels - 1) for part in data)


def nearest(word: str, words: list[str]) -> str:
    """A did-you-mean for `word`, or the list of what there is."""
    close = _close(word, words)
    if not close:  # 'noise' for 'simulation.noise'
        close = [known for known in words if known.rpartition(".")[2] == word]
    if close:
        return f"did you mean '{close[0]}'?"
    return f"valid: {', '.join(words)}" if words else "none is valid here"


def _close(word: str, words: list[str]) -> list[str]:
    """The nearest, if it is near enough; in microseconds, however long the word is."""
    if len(word) > LONGEST_WORD:
        return []
    letters = set(word)

    def distance(known: str) -> int:
        return len(letters.symmetric_difference(known)) + abs(len(known) - len(word))

    candidates = heapq.nsmallest(_CANDIDATES, words, distance)  # difflib alone takes milliseconds
    return difflib.get_close_matches(word, candidates, n=1, cutoff=0.6)


def leaves(struct: type[Struct], prefix: str = "") -> list[str]:
    """Every key of `struct` and its sections in dotted form."""
    keys = [prefix + field.name for field in fields_of(struct)]
    for name, section in _sections(struct):
        keys += leaves(section, f"{prefix}{name}.")
    return keys


def _describe(field: inspect.Field) -> Field:
    kind, optional = field.type, False
    extra: dict[str, Any] = {}
    if isinstance(kind, inspect.Metadata):
        extra = kind.extra_json_schema or {}
        kind = kind.type
    if isinstance(kind, inspect.UnionType):
        optional = True
        kind = next(part for part in kind.types if not isinstance(part, inspect.NoneType))
    default = field.default if isinstance(field.default, Scalar) else None
    return Field(
        name=field.encode_name,
        kind=_KINDS.get(type(kind), "text"),
        unit=extra.get("unit", ""),
        description=extra.get("description", ""),
        default=default,
        interval=_interval(kind),
        optional=optional,
        required=field.required,
        file=extra.get("file", ""),
    )


def _interval(kind: inspect.Type) -> str:
    if isinstance(kind, inspect.StrType) and kind.max_length is not None:
        return f"up to {kind.max_length} printable characters"
    if isinstance(kind, inspect.LiteralType):
        return " | ".join(str(value) for value in kind.values)
    if isinstance(kind, inspect.VarTupleType):
        return _interval(kind.item_type)
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
    keys = re.findall(r"[^.\[\]`]+", where)
    while keys and keys[-1].isdigit():  # an element of a list is shown with all of the list
        keys.pop()
    path = tuple(key for key in keys if not key.isdigit())
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
        if key in everywhere and "." in key:
            section, _, name = key.rpartition(".")
            hint = f"write '{section}:' and below it, indented, '{name}:'"
        return (*path, key), f"unknown key; {hint}"
    missing = re.search(r"missing required field `(.*)`", complaint)
    if missing:
        key = missing.group(1)
        return (*path, key), f"is missing: {_wanted(target, (*path, key))}"
    value = data
    for key in keys:
        if isinstance(value, Mapping):
            value = value[key]
        elif isinstance(value, list | tuple):
            value = value[int(key)]
    return path, f"{_shown(value)} is not valid: {_wanted(target, path)}"


def _struct_at(target: type[Struct], path: tuple[str, ...]) -> type[Struct]:
    for key in path:
        target = next(part for name, part in _sections(target, in_lists=True) if name == key)
    return target


def _sections(
    target: type[Struct], *, in_lists: bool = False
) -> Iterator[tuple[str, type[Struct]]]:
    """The fields of a struct that are structs themselves, or lists of them where wanted."""
    for field in _info(target).fields:
        kind = field.type.type if isinstance(field.type, inspect.Metadata) else field.type
        if in_lists and isinstance(kind, inspect.VarTupleType):
            kind = kind.item_type
        if isinstance(kind, inspect.StructType):
            yield field.name, kind.cls


def _wanted(target: type[Struct], path: tuple[str, ...]) -> str:
    if not path:
        return "a mapping of keys to values is needed"
    fields = fields_of(_struct_at(target, path[:-1]))
    field = next(field for field in fields if field.name == path[-1])
    return f"{wanted(field)} is needed"


def _shown(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return spelled(value)
    return text.quoted(_glimpse.repr(value))


_glimpse = reprlib.Repr()
"""Spells only as much of a value as is shown."""
_glimpse.maxstring = _glimpse.maxother = _glimpse.maxlong = text.LONGEST_WORD
_glimpse.maxlist = _glimpse.maxtuple = _glimpse.maxdict = 10


def spelled(value: Any) -> str:
    """A value as it would be written in YAML or JSON."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value)
