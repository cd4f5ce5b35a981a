"""Bounds, units and descriptions of parameters, declared in one place.

Configuration sections and controller parameters are msgspec structs whose fields carry bounds, unit
and description (`unit`, `note`). From those this module takes validation with readable errors
(`convert`) and a description (`fields_of`) for help texts, command-line options and documentation.
"""

import math
import re
import reprlib
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from typing import Annotated, Any, TypeGuard, TypeVar, cast

import msgspec
from msgspec import Meta, Struct, inspect

from fishd.core import text

MAX_SUGGESTION_CHARACTERS = 100
"""Maximum length of a word for which a suggestion is searched [characters]."""
_MAX_CANDIDATES = 5
PRINTABLE = "^[^\x00-\x1f\x7f-\x9f]*$"
"""Pattern of a text without control characters."""

T = TypeVar("T")

Scalar = bool | int | float | str | None


def unit(
    symbol: str,
    description: str,
    *,
    file: str = "",
    usual: float = 0.0,
    step: float = 0.0,
    **constraints: Any,
) -> Meta:
    """Describe a field: `Annotated[float, unit("Hz", "Frequency of the command.", gt=0, le=10)]`.

    symbol: unit in SI notation, `1` for a pure number
    file: suffix, such as `.onnx`, of a text that may be the path of a file
    usual: largest magnitude that is reasonable on a real fish, if the bounds are wider; see
    `find_doubts`
    step: smallest change of a number that makes a difference, for pages and panels; derived from
    the bounds if absent
    constraints: those of `msgspec.Meta`, such as gt, ge, lt, le, min_length, pattern
    """
    extra: dict[str, Any] = {"unit": symbol}
    given = {"file": file, "usual": usual, "step": step}
    extra |= {name: value for name, value in given.items() if value}
    return Meta(description=description, extra_json_schema=extra, **constraints)


def note(description: str, **constraints: Any) -> Meta:
    """Describe a field without a unit, such as a name, a switch or a section; see `unit`."""
    return Meta(description=description, **constraints)


class Field(Struct, frozen=True, omit_defaults=True):
    """Description of one field of a struct, for help texts and option parsers."""

    name: str
    kind: str
    """number, integer, text, boolean, choice, section or list"""
    unit: str
    description: str
    default: Scalar
    optional: bool
    """True if null is permitted."""
    low: float | None = None
    """Least value of a number, or of the numbers of a list, or least length of a text."""
    high: float | None = None
    """Largest value or length, as for `low`."""
    low_open: bool = False
    """True if `low` itself is not permitted."""
    high_open: bool = False
    choices: tuple[str, ...] = ()
    """Permitted values of a choice, or of the entries of a list."""
    items: str = ""
    """Kind of the entries of a list, as in `kind`."""
    required: bool = False
    """True if the field has no default."""
    file: str = ""
    """Suffix, such as `.onnx`, of a text that may be the path of a file: see `names_file`."""
    words: tuple[str, ...] = ()
    """Words that are permitted besides a number, such as `auto`."""
    usual: float = 0.0
    """Largest magnitude that is reasonable on a real fish, if the bounds are wider; else 0."""
    step: float = 0.0
    """Step in which a page or a panel changes a number; 0 for none."""


class Reading(Struct, frozen=True):
    """Description of a quantity that a sensor reads."""

    unit: Annotated[str, Meta(description="Unit in SI notation, or `°C`; `1` for a pure number.")]
    description: Annotated[str, Meta(description="Description in one line.")]
    low: Annotated[
        float | None, Meta(description="Value below which a reading is doubtful; null for none.")
    ] = None
    high: Annotated[
        float | None, Meta(description="Value above which it is doubtful; null for none.")
    ] = None


class Problem(Exception):
    """A value is invalid; `path` holds the keys that lead to it."""

    def __init__(self, path: tuple[str, ...], message: str) -> None:
        super().__init__(message)
        self.path = path

    def message_with_place(self, sources: Mapping[tuple[str, ...], str]) -> str:
        """Return the message with the place of its key, of a key below it, or of its section.

        sources: place where each key was set, such as `fish.yaml:3`
        """
        path = self.path
        places_within = [
            place for key, place in sources.items() if path and key[: len(path)] == path
        ]
        places_above = [sources[path[:n]] for n in range(len(path) + 1) if path[:n] in sources]
        where = sources.get(path) or (places_within or places_above[::-1] or [""])[0]
        return ": ".join(part for part in (where, ".".join(path), str(self)) if part)


class UnknownKey(Problem):
    """A key does not exist; it is the last of `path`."""


_KINDS: dict[type[inspect.Type], str] = {
    inspect.FloatType: "number",
    inspect.IntType: "integer",
    inspect.StrType: "text",
    inspect.BoolType: "boolean",
    inspect.LiteralType: "choice",
    inspect.StructType: "section",
    inspect.DictType: "section",
    inspect.VarTupleType: "list",
    inspect.TupleType: "list",
}


def drop_empty_sections(data: Mapping[str, Any], target: type[Struct]) -> dict[str, Any]:
    """Return `data` without its empty sections (null), which then take their defaults."""
    kept = dict(data)
    for name, section in _sections(target):
        if isinstance(kept.get(name), Mapping):
            kept[name] = drop_empty_sections(kept[name], section)
        elif name in kept and kept[name] is None:
            del kept[name]
    return kept


@lru_cache(maxsize=256)  # requests need the fields of controllers
def fields_of(struct: type[Struct]) -> tuple[Field, ...]:
    """Return the fields of a parameter struct, in the order of their declaration."""
    return tuple(_describe(field) for field in _info(struct).fields)


@lru_cache(maxsize=256)
def _info(struct: type[Struct]) -> inspect.StructType:
    _prepare(struct)
    return cast(inspect.StructType, inspect.type_info(struct))


def convert(
    data: Any,
    target: type[T],
    *,
    prefix: tuple[str, ...] = (),
    elsewhere: Callable[[], list[str]] = list,
) -> T:
    """Validate `data` into the struct `target`.

    Raise `Problem`, whose message names the permitted values or the most similar valid key and
    whose path begins with `prefix`.

    elsewhere: returns more keys for suggestions, in dotted form
    """
    _prepare(target)
    try:
        return msgspec.convert(data, target)
    except msgspec.ValidationError as error:
        problem = _explain(error, data, cast(type[Struct], target), elsewhere)
        problem.path = prefix + problem.path
        raise problem from None


_prepared: set[Any] = set()
_preparing = threading.Lock()


def _prepare(target: Any) -> None:
    """Use a type for the first time in one thread only: in two threads at once, msgspec crashes."""
    if target in _prepared:
        return
    with _preparing:
        msgspec.json.Decoder(target)
        _prepared.add(target)


_JSON_TYPES = {
    "number": "number",
    "integer": "integer",
    "boolean": "boolean",
    "section": "object",
    "list": "array",
}


def schema_name(message: type[Struct]) -> str:
    """Return the name of the JSON Schema of a message, such as `fishd.Tick`."""
    return f"fishd.{message.__name__}"


def json_schema(message: type[Struct], readings: Mapping[str, Reading] | None = None) -> bytes:
    """Return the flat JSON Schema of a message, as Foxglove and its relatives need it.

    They take a root of type object, without `$ref` and `anyOf`: nested values are plain objects.

    readings: readings of the sensors, which are described in the field `readings` of a tick
    """
    properties: dict[str, Any] = {}
    for field in fields_of(message):
        properties[field.name] = _json_property(field)
    if readings and "readings" in properties:
        properties["readings"]["properties"] = {
            name: _json_property(Field(name, "number", each.unit, each.description, None, True))
            for name, each in readings.items()
        }
    title = schema_name(message)
    return msgspec.json.encode({"title": title, "type": "object", "properties": properties})


def _json_property(field: Field) -> dict[str, Any]:
    description = f"{field.description} [{field.unit}]" if field.unit else field.description
    return {"type": _JSON_TYPES.get(field.kind, "string"), "description": description}


def describe_permitted(field: Field) -> str:
    """Return the permitted values of a field in words: `a number in [0, 1] rad (or null)`."""
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
    permitted = format_permitted(field)
    symbol = "" if field.unit == "1" else field.unit
    words = (kind, preposition + permitted if permitted else "", symbol)
    alternatives = [*field.words, *(["null"] if field.optional else [])]
    return " ".join(filter(None, words)) + (
        f" (or {' or '.join(alternatives)})" if alternatives else ""
    )


def format_permitted(field: Field) -> str:
    """Return the permitted values: `(0, 2]`, `a | b`, `1 to 40 printable characters`, or empty."""
    if field.choices:
        return " | ".join(field.choices)
    kind = field.items or field.kind
    if kind == "text":
        shortest = f"{field.low:g}" if field.low else "up"
        return "" if field.high is None else f"{shortest} to {field.high:g} printable characters"
    if field.low is None and field.high is None:
        return ""
    low = "(-inf" if field.low is None else f"{'(' if field.low_open else '['}{field.low:g}"
    high = "inf)" if field.high is None else f"{field.high:g}{')' if field.high_open else ']'}"
    return f"{'whole numbers in ' if field.items == 'integer' else ''}{low}, {high}"


def names_file(text: str, suffix: str) -> bool:
    """Return whether this text is the path of a file rather than a name."""
    return "/" in text or text.endswith(suffix)


def nested_too_deeply(data: Any, levels: int = 20) -> bool:
    """Return whether lists and mappings have more levels, which may overflow an encoder's stack."""
    if isinstance(data, Mapping):
        data = list(data.values())
    if not isinstance(data, list):
        return False
    return levels == 0 or any(nested_too_deeply(part, levels - 1) for part in data)


def suggest(word: str, words: list[str], *, listed: str = "valid") -> str:
    """Return a did-you-mean hint for `word`, or the list of `words`, introduced by `listed`."""
    matches = [known for known in words if known.lower() == word.lower()] or _find_similar(
        word, words
    )
    if not matches:  # 'noise' for 'simulation.noise'
        matches = [known for known in words if known.rpartition(".")[2] == word]
    if matches:
        return f"did you mean '{matches[0]}'?"
    return f"{listed}: {', '.join(words)}" if words else "none is valid here"


def _find_similar(word: str, words: list[str]) -> list[str]:
    """Return the most similar word, if it is similar enough; takes microseconds for any length."""
    if len(word) > MAX_SUGGESTION_CHARACTERS:
        return []
    import difflib  # only needed for a wrong word
    import heapq

    letters = set(word)

    def distance(known: str) -> int:
        return len(letters.symmetric_difference(known)) + abs(len(known) - len(word))

    # `difflib` alone takes milliseconds.
    candidates = heapq.nsmallest(_MAX_CANDIDATES, words, distance)
    return difflib.get_close_matches(word, candidates, n=1, cutoff=0.6)


def list_keys(struct: type[Struct], prefix: str = "") -> list[str]:
    """Return all keys of `struct` and its sections in dotted form."""
    keys = [prefix + field.name for field in fields_of(struct)]
    for name, section in _sections(struct):
        keys += list_keys(section, f"{prefix}{name}.")
    return keys


def _unwrap(kind: inspect.Type) -> tuple[inspect.Type, dict[str, Any], bool]:
    """Return a type without metadata and null, its metadata, and whether null is permitted."""
    extra: dict[str, Any] = {}
    if isinstance(kind, inspect.Metadata):
        extra, kind = kind.extra_json_schema or {}, kind.type
    if isinstance(kind, inspect.UnionType):
        kinds = [part for part in kind.types if not isinstance(part, inspect.NoneType)]
        return kinds[0], extra, len(kinds) < len(kind.types)
    return kind, extra, False


def _literal_words(kind: inspect.Type) -> tuple[str, ...]:
    """Return the words of a Literal that a field accepts besides its first type."""
    if isinstance(kind, inspect.Metadata):
        kind = kind.type
    if not isinstance(kind, inspect.UnionType):
        return ()
    literals = [part for part in kind.types if isinstance(part, inspect.LiteralType)]
    return tuple(str(word) for part in literals for word in part.values)


def _describe(field: inspect.Field) -> Field:
    kind, extra, optional = _unwrap(field.type)
    name, permitted = _KINDS.get(type(kind), "text"), _permitted(kind)
    return Field(
        name=field.encode_name,
        kind=name,
        unit=extra.get("unit", ""),
        description=extra.get("description", ""),
        default=field.default if isinstance(field.default, Scalar) else None,
        optional=optional,
        **permitted,
        required=field.required,
        file=extra.get("file", ""),
        words=_literal_words(field.type) if name == "number" else (),
        usual=extra.get("usual", 0.0),
        step=extra.get("step", 0.0) or _derive_step(name, permitted, field.default),
    )


def _derive_step(kind: str, permitted: Mapping[str, Any], default: Any) -> float:
    """Return a power of ten: at least 50 steps from bound to bound, or 10 from 0 to the default."""
    if kind != "number":
        return float(kind == "integer")
    low, high = permitted["low"], permitted["high"]
    if low is not None and high is not None:
        size = (high - low) / 50.0
    else:
        size = abs(default) / 10.0 if _is_number(default) else 0.0
    return float(10.0 ** math.floor(math.log10(size))) if size > 0.0 else 0.0


def _permitted(kind: inspect.Type) -> dict[str, Any]:
    """Return the permitted values of a type, as fields of `Field`."""
    if isinstance(kind, inspect.StrType):
        return {"low": kind.min_length, "high": kind.max_length}
    if isinstance(kind, inspect.LiteralType):
        return {"choices": tuple(map(str, kind.values))}
    if isinstance(kind, inspect.VarTupleType):
        return {"items": _KINDS.get(type(kind.item_type), "text"), **_permitted(kind.item_type)}
    if not isinstance(kind, inspect.FloatType | inspect.IntType):
        return {}
    return {
        "low": kind.ge if kind.gt is None else kind.gt,
        "high": kind.le if kind.lt is None else kind.lt,
        "low_open": kind.gt is not None,
        "high_open": kind.lt is not None,
    }


def _explain(
    error: msgspec.ValidationError,
    data: Any,
    target: type[Struct],
    elsewhere: Callable[[], list[str]],
) -> Problem:
    """Convert msgspec's error to a path and one readable sentence."""
    complaint, _, location = str(error).partition(" - at `$")
    keys = re.findall(r"[^.\[\]`]+", location)
    while keys and keys[-1].isdigit():  # for an element of a list, the message has the whole list
        keys.pop()
    path = tuple(key for key in keys if not key.isdigit())
    if unknown := re.search(r"unknown field `(.*)`", complaint):
        return _unknown_key(unknown[1], path, target, elsewhere())
    if missing := re.search(r"missing required field `(.*)`", complaint):
        path = (*path, missing[1])
        return Problem(path, f"is missing: {describe_permitted(_field_at(target, path))} is needed")
    value = data
    for key in keys:
        if isinstance(value, Mapping):
            value = value[key]
        elif isinstance(value, list | tuple):
            value = value[int(key)]
    if not path:
        return Problem(
            path, f"{format_excerpt(value)} is not valid: a mapping of keys to values is needed"
        )
    field = _field_at(target, path)
    hint = _ask_for_other_unit(value, field) or _ask_for_hexadecimal(value, field)
    return Problem(
        path,
        f"{format_excerpt(value)} is not valid: {describe_permitted(field)} is needed"
        + (hint or _entry_hint(value, field)),
    )


def _unknown_key(
    key: str, path: tuple[str, ...], target: type[Struct], elsewhere: list[str]
) -> UnknownKey:
    """Suggest a key of the same section, else of any section, else list the keys of the section."""
    valid = [field.name for field in fields_of(_struct_at(target, path))]
    all_keys = [".".join((*path, name)) for name in valid] + list_keys(target) + elsewhere
    hint = suggest(key, valid)
    if "." in key and key in all_keys:
        section, _, name = key.rpartition(".")
        hint = f"write '{section}:' and below it, indented, '{name}:'"
    elif not hint.startswith("did") and (wider_hint := suggest(key, all_keys)).startswith("did"):
        hint = wider_hint
    return UnknownKey((*path, key), f"unknown key; {hint}")


def _ask_for_hexadecimal(value: Any, field: Field) -> str:
    """Return a hint if the digits of an I2C address are valid as hexadecimal ones, or empty."""
    if "address" not in field.name or field.kind != "integer":
        return ""
    try:
        address = int(str(value), 16)
    except ValueError:
        return ""
    return f"; {address:#04x} may be meant" if _is_within(address, field) else ""


def _ask_for_other_unit(value: Any, field: Field) -> str:
    """Return a question if a value is valid only in another common unit.

    An angle may be in degrees, other values in thousandths: ` (mN? that is 0.02 N)`.
    """
    _, factor = _OTHER_UNITS.get(field.unit, ("", 0.0))
    if field.kind != "number" or not factor or not _is_number(value):
        return ""
    is_plausible = abs(value) <= (360 if field.unit == "rad" else _MAX_IN_OTHER_UNIT)
    is_meant = is_plausible and _is_within(factor * value, field)
    return f" ({ask_for_unit(value, field.unit)})" if is_meant else ""


def ask_for_unit(value: float, symbol: str) -> str:
    """Return the question whether another unit was meant: `mN? that is 0.02 N`."""
    name, factor = _OTHER_UNITS[symbol]
    return f"{name}? that is {factor * value:.3g} {symbol}"


_OTHER_UNITS = {
    "rad": ("degrees", math.pi / 180.0),
    "N": ("mN", 1e-3),
    "s": ("ms", 1e-3),
    "m": ("mm", 1e-3),
    "V": ("mV", 1e-3),
    "A": ("mA", 1e-3),
}
"""Other common unit of a field by its unit, and the factor that converts it to that unit."""


_MAX_IN_OTHER_UNIT = 1e6
"""Largest value that may have been meant in another unit."""


def find_doubts(values: Mapping[str, Any], fields: Iterable[Field]) -> list[str]:
    """Return a sentence for each value that is valid, but unreasonably large.

    values: parameters by name
    """
    doubts = []
    for field in fields:
        if not (field.usual and is_valid_number(values, field)):
            continue
        value, symbol = values[field.name], field.unit
        if abs(value) > field.usual:
            hint = f" ({ask_for_unit(value, symbol)})" if symbol in _OTHER_UNITS else ""
            doubts.append(
                f"{field.name}: {format_quantity(value, symbol)} is more than makes sense: up to "
                f"{format_quantity(field.usual, symbol)} does{hint}"
            )
    return doubts


def parse_value(field: Field, text: str) -> Any:
    """Return the value of a field for a text of a command line; raise ValueError.

    Whether a number is within its interval is not checked.
    """
    if field.optional and text.lower() in ("null", "none", "default"):
        return None
    if text in field.words:
        return text
    try:
        if field.kind == "boolean":
            return _BOOLEANS[text.lower()]
        if field.kind in ("number", "integer") and "_" in text:  # Python reads 1_0 as 10
            raise ValueError
        value = {"number": float, "integer": int}.get(field.kind, str)(text)
        if value in (math.inf, -math.inf) or value != value:
            raise ValueError
    except (KeyError, ValueError):
        raise ValueError(f"'{text}' is not valid: {describe_permitted(field)} is needed") from None
    return value


_BOOLEANS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


def is_valid_number(values: Mapping[str, Any], field: Field) -> bool:
    """Return whether the value of this field is a number within its interval."""
    value = values.get(field.name)
    return _is_number(value) and _is_within(value, field)


def _is_within(value: float, field: Field) -> bool:
    """Return whether a number is within the interval of a field."""
    low, high = field.low, field.high
    above = low is None or value > low or (value == low and not field.low_open)
    below = high is None or value < high or (value == high and not field.high_open)
    return above and below


def format_quantity(value: Any, symbol: str) -> str:
    """Return a value as text, a number with its unit: `0.01 N`, `0.6`, `default`."""
    if value is None:
        return "default"
    number = f"{value:g}" if _is_number(value) and float(f"{value:g}") == value else str(value)
    return f"{number} {symbol}" if symbol not in ("", "1") and _is_number(value) else number


def format_reading(value: float, symbol: str) -> str:
    """Return a measured value with its unit, to four digits: `21.25 °C`."""
    return f"{value:.4g} {'' if symbol == '1' else symbol}".rstrip()


def format_values(values: Mapping[str, Any], units: Mapping[str, str], separator: str = " ") -> str:
    """Return values with their names and units: `target=0.01 N C=0.6 amplitude=default`."""
    words = (f"{name}={format_quantity(v, units.get(name, ''))}" for name, v in values.items())
    return separator.join(words)


def unit_at(target: type[Struct], key: str) -> str:
    """Return the unit of a key of a struct and its sections, in dotted form; empty if unknown."""
    try:
        return _field_at(target, tuple(key.split("."))).unit
    except StopIteration:
        return ""


def units_of(fields: Iterable[Field]) -> dict[str, str]:
    """Return the unit of each field by its name."""
    return {field.name: field.unit for field in fields}


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _entry_hint(value: Any, field: Field) -> str:
    """Return a hint to write a single value as a list, or the wrong word of a list."""
    if field.kind != "list":
        return ""
    if not isinstance(value, list):
        is_number = field.items == "integer" and type(value) is int and _is_within(value, field)
        return f": write [{value}]" if is_number or value in field.choices else ""
    wrong = [format_excerpt(entry) for entry in value if entry not in field.choices]
    return f"; {wrong[0]} is none of them" if wrong and field.choices else ""


def _field_at(target: type[Struct], path: tuple[str, ...]) -> Field:
    fields = fields_of(_struct_at(target, path[:-1]))
    return next(field for field in fields if field.name == path[-1])


def _struct_at(target: type[Struct], path: tuple[str, ...]) -> type[Struct]:
    for key in path:
        target = next(part for name, part in _sections(target, everywhere=True) if name == key)
    return target


def _sections(
    target: type[Struct], *, everywhere: bool = False
) -> Iterator[tuple[str, type[Struct]]]:
    """Yield name and type of each field of a struct that is a struct itself.

    everywhere: include fields that may be null, and lists of structs
    """
    for field in _info(target).fields:
        kind = field.type.type if isinstance(field.type, inspect.Metadata) else field.type
        if everywhere:
            kind = _unwrap(kind)[0]
        if everywhere and isinstance(kind, inspect.VarTupleType):
            kind = kind.item_type
        if isinstance(kind, inspect.StructType):
            yield field.name, kind.cls


def format_excerpt(value: Any) -> str:
    """Return a value for a message, shortened if it is long."""
    if value is None or isinstance(value, bool):
        return format_literal(value)
    return text.quoted(_excerpt.repr(value))


_excerpt = reprlib.Repr()
"""Formatter of shortened values."""
_excerpt.maxstring = _excerpt.maxother = _excerpt.maxlong = text.MAX_WORD_CHARACTERS
_excerpt.maxlist = _excerpt.maxtuple = _excerpt.maxdict = 10


def format_literal(value: Any) -> str:
    """Return a value in the notation of YAML or JSON."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value)
