"""Reader of YAML that keeps the line of each key, and refuses repeated keys.

The values are those of YAML 1.2's core schema: PyYAML itself follows YAML 1.1, in which `on` is
true, `1e2` is a text, `1:30` is ninety, `010` is eight, and the second of two equal keys wins.
"""

import os
import pathlib
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import yaml

from fishd.core import files
from fishd.core.errors import ConfigError

Path = tuple[str, ...]
"""The keys that lead to a value."""


class Document(NamedTuple):
    """A YAML document as plain values, and the line of every key."""

    data: Any
    lines: dict[Path, int]


class YamlProblem(Exception):
    """The YAML is invalid; `line` counts from 1."""

    def __init__(self, line: int, message: str) -> None:
        super().__init__(message)
        self.line = line


class ValueProblem(YamlProblem):
    """One value is invalid; the rest of the document can be read."""


_MAX_DEPTH = 20
_MAX_NODES = 2000
"""Maximum number of values and keys in one document; an alias counts as everything it refers to."""
_MAX_NUMBER_CHARACTERS = 100
_TAG = "tag:yaml.org,2002:"
_CORE_SCHEMA = {
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+",
    "float": r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
    r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
}
"""Plain scalars that are not texts, by tag; see section 10.3.2 of the specification of YAML 1.2."""


def read(
    file: str | os.PathLike[str], reader: str, example: str, mistakes: list[str] | None = None
) -> tuple[dict[str, Any], dict[Path, str]]:
    """Return the mapping in a file, and the place of each key, such as `fish.yaml:3`.

    reader: purpose of the file, such as `a configuration`; example: a valid line
    mistakes: receives the problems of single values, which are then left out
    Raise `ConfigError` with file and line.
    """
    problems: list[ValueProblem] | None = None if mistakes is None else []
    try:
        text = files.read_text(pathlib.Path(file), files.MAX_SETTINGS_BYTES, reader)
        data, lines = parse(text, problems=problems)
    except YamlProblem as problem:
        raise ConfigError(f"{file}:{problem.line}: {problem}") from None
    except files.NoFile as problem:
        raise ConfigError(f"{file}: {problem}; give the path of a YAML file") from None
    except files.FileProblem as problem:
        raise ConfigError(f"{file}: {problem}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{file}:1: keys and values are needed, such as '{example}'")
    if mistakes is not None:
        mistakes += [f"{file}:{problem.line}: {problem}" for problem in problems or ()]
    return data, {key: f"{file}:{line}" for key, line in lines.items()}


def parse(
    text: str,
    name: str = "the document",
    problems: list[ValueProblem] | None = None,
    *,
    typed: bool = True,
) -> Document:
    """Parse `text`; raise `YamlProblem`.

    name: name of a value outside of any key, for the error
    problems: receives the problems of single values, which are then left out
    typed: whether a person typed the text, and may have typed odd white space; False for `dump`'s
    """
    if len(text) > files.MAX_SETTINGS_BYTES:
        raise YamlProblem(1, f"longer than {files.MAX_SETTINGS_BYTES // 2**10} kB")
    try:
        loader = _Loader(text)
        root = loader.get_single_node()
        if typed and not text.isascii():
            _check_white_space(text, root)
    except yaml.MarkedYAMLError as error:
        raise _explain(text, error) from None
    except yaml.reader.ReaderError as error:
        character = text[error.position]
        line = text.count("\n", 0, error.position) + 1
        raise YamlProblem(line, f"{_name(character)} is not permitted: remove it") from None
    except yaml.YAMLError as error:
        raise YamlProblem(1, f"not valid YAML: {' '.join(str(error).split())}") from None
    except (ValueError, OverflowError):  # an escape such as "\\U00110000"
        raise YamlProblem(1, "not valid YAML: a character that does not exist") from None
    except RecursionError:
        raise YamlProblem(1, "nested too deeply") from None
    builder = _Builder(loader, name, problems)
    return Document({} if root is None else builder.build(root, ()), builder.lines)


def dump(data: Any) -> str:
    """Return plain values as YAML that readers of YAML 1.1 and 1.2 understand."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


class _Loader(yaml.SafeLoader):
    """Loader of plain scalars as in the core schema."""

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """Return an integer in decimal, octal (`0o17`) or hexadecimal digits (`0xff`)."""
        digits = str(node.value)
        return int(digits, 0 if digits.startswith(("0o", "0x")) else 10)


class _Dumper(yaml.SafeDumper):
    """Dumper that quotes a text that would be another value or be refused by `parse`."""

    def analyze_scalar(self, scalar: str) -> Any:
        """Do as the base class; odd white space needs quotes."""
        analysis = super().analyze_scalar(scalar)
        if not scalar.isascii() and any(map(_is_odd, scalar)):
            analysis.allow_flow_plain = analysis.allow_block_plain = False
        return analysis


_Loader.yaml_implicit_resolvers = {}  # instead of those of YAML 1.1
_Loader.add_constructor(_TAG + "int", _Loader.construct_yaml_int)
for _tag, _pattern in _CORE_SCHEMA.items():
    for _class in _Loader, _Dumper:
        _class.add_implicit_resolver(_TAG + _tag, re.compile(f"(?:{_pattern})\\Z"), None)


class _Builder:
    """Converter of the nodes of a document to plain values."""

    def __init__(self, loader: _Loader, name: str, problems: list[ValueProblem] | None) -> None:
        self.lines: dict[Path, int] = {}
        self._loader = loader
        self._name = name
        self._problems = problems
        self._count = 0

    def build(self, node: yaml.Node, path: Path) -> Any:
        """Return the value of the node at this path of keys."""
        line = node.start_mark.line + 1
        self._count += 1
        if self._count > _MAX_NODES:
            raise YamlProblem(
                line,
                f"more than {_MAX_NODES} values and keys, each alias counted as all that it "
                "refers to",
            )
        if len(path) > _MAX_DEPTH:  # an alias that contains itself has no end
            raise YamlProblem(line, f"{'.'.join(path[:3])}...: nested too deeply")
        self.lines.setdefault(path, line)
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode):
            return [self.build(item, (*path, str(i))) for i, item in enumerate(node.value)]
        assert isinstance(node, yaml.ScalarNode)
        return self._scalar(node, ".".join(path) or self._name, line)

    def _mapping(self, node: yaml.MappingNode, path: Path) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode):
                raise YamlProblem(line, "a key must be a plain word")
            key = str(key_node.value)
            _check_characters(key, "a key", line)
            key_path = (*path, key)
            try:
                if key in mapping:
                    raise ValueProblem(
                        line,
                        f"{'.'.join(key_path)}: duplicate key, first given on line "
                        f"{self.lines[key_path]}; keep one",
                    )
                self.lines[key_path] = line
                mapping[key] = self.build(value_node, key_path)
            except ValueProblem as problem:
                if self._problems is None:
                    raise
                self._problems.append(problem)
        return mapping

    def _scalar(self, node: yaml.ScalarNode, name: str, line: int) -> Any:
        length = len(node.value)
        if length > _MAX_NUMBER_CHARACTERS and node.tag.endswith((":int", ":float")):
            raise ValueProblem(
                line,
                f"{name}: a number of {length} characters; at most {_MAX_NUMBER_CHARACTERS} are "
                "permitted",
            )
        _check_characters(str(node.value), name, line)
        try:
            return self._loader.construct_object(node, deep=True)
        except (yaml.YAMLError, ValueError) as error:
            raise ValueProblem(line, f"{name}: {' '.join(str(error).split())}") from None
        except (LookupError, AttributeError):  # PyYAML's errors for an explicit tag
            tag = node.tag.rpartition(":")[2]
            raise ValueProblem(line, f"{name}: a value that is not of the tag '{tag}'") from None


def _check_characters(text: str, name: str, line: int) -> None:
    """Refuse surrogates (halves of characters), which an escape can create and no file can hold."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueProblem(line, f"{name}: half of a character (\\ud800…\\udfff)") from None


_CONTROL_CHARACTERS = {"\0": "NUL", "\x1a": "Ctrl-Z", "\x1b": "ESC", "\x7f": "DEL"}


def _name(character: str) -> str:
    """Return a name such as `a no-break space (U+00A0)`."""
    import unicodedata  # only for what is refused

    default = "a control character" if ord(character) < 0xA0 else "a character"
    name = _CONTROL_CHARACTERS.get(character) or unicodedata.name(character, default).lower()
    article = "" if character in _CONTROL_CHARACTERS or name == default else "a "
    article = "an " if article and name[0] in "aeio" else article
    return f"{article}{name} (U+{ord(character):04X})"


_INVISIBLE = "\u200b\u2060\ufeff"
"""Characters without width that separate words, and change no other character."""
_OVERRIDES = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
"""Characters that show a text in another order than that in which it is read."""


def _is_odd(character: str) -> bool:
    """Return whether a character looks like a space, or like none, but is not one for YAML.

    Joiners, as in emoji and Persian, soft hyphens and marks of direction are parts of words.
    """
    return not character.isascii() and (
        character.isspace() or character in _INVISIBLE or character in _OVERRIDES
    )


def _check_white_space(text: str, root: yaml.Node | None) -> None:
    """Refuse odd white space outside of quotes, comments and blocks of text."""
    positions = [n for n, character in enumerate(text) if _is_odd(character)]
    if not positions or root is None:
        return
    scalars = list(_scalars(root, set()))
    for n in positions:
        styles = [s.style for s in scalars if s.start_mark.index <= n < s.end_mark.index]
        begins_text = n == 0 and text[n] == "\ufeff"  # a byte order mark
        if not begins_text and (None in styles or (not styles and text[n] in _LINE_BREAKS)):
            raise YamlProblem(text.count("\n", 0, n) + 1, _describe_odd(text[n]))


_LINE_BREAKS = "\x85\u2028\u2029"
"""Characters that end a line in YAML 1.1, but neither in YAML 1.2 nor in editors."""


def _scalars(node: yaml.Node, seen: set[int]) -> Iterator[yaml.ScalarNode]:
    """Yield each scalar of a document once."""
    if id(node) in seen:
        return
    seen.add(id(node))
    if isinstance(node, yaml.ScalarNode):
        yield node
    for item in node.value if isinstance(node, yaml.CollectionNode) else ():
        for child in item if isinstance(item, tuple) else (item,):
            yield from _scalars(child, seen)


def _describe_odd(character: str) -> str:
    return f"{_name(character)} is not a space for YAML: type a space, or put the text in quotes"


def _explain(text: str, error: yaml.MarkedYAMLError) -> YamlProblem:
    """Return the problem of an invalid document; white space that only looks right is named."""
    mark = error.problem_mark or error.context_mark
    if not mark:
        return YamlProblem(1, f"not valid YAML: {error.problem}")
    begin = (error.context_mark or mark).index
    begin = text.rfind("\n", 0, begin) + 1
    if odd := next(filter(_is_odd, reversed(text[begin : mark.index + 1])), ""):
        line = text.count("\n", 0, text.rfind(odd, 0, mark.index + 1)) + 1
        return YamlProblem(line, _describe_odd(odd))
    if text[mark.index : mark.index + 1] == "\t":
        return YamlProblem(mark.line + 1, "a tab is not permitted here: type spaces instead")
    return YamlProblem(mark.line + 1, f"not valid YAML: {error.problem}")
