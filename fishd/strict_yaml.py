"""YAML as people mean it: values with the line they stand on, and no silent surprises.

PyYAML follows YAML 1.1, in which `on` is true, `1e2` is a text, `1:30` is ninety and the second of
two equal keys wins. Each of these is refused here, with the line and what to write instead.
"""

import re
from typing import Any, NamedTuple

import yaml

Path = tuple[str, ...]


class Document(NamedTuple):
    """A YAML document as plain values, and the line of every key."""

    data: Any
    lines: dict[Path, int]


class YamlProblem(Exception):
    """The text is not acceptable YAML; `line` counts from 1."""

    def __init__(self, line: int, message: str) -> None:
        super().__init__(message)
        self.line = line


_WORDS = {"on": "true", "yes": "true", "y": "true", "off": "false", "no": "false", "n": "false"}
_BARE_EXPONENT = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+")
_SEXAGESIMAL = re.compile(r"[-+]?[0-9]+(:[0-5]?[0-9])+(\.[0-9]*)?")
_DEEPEST = 20
_OCTAL = re.compile(r"[-+]?0[0-7_]+")


def parse(text: str, name: str = "the document") -> Document:
    """Parse `text`; raises `YamlProblem`. A lone value is called `name` in complaints."""
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except RecursionError:
        raise YamlProblem(1, "nested too deeply") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise YamlProblem(line, f"not valid YAML: {error.problem}") from None
    except yaml.YAMLError as error:
        raise YamlProblem(1, f"not valid YAML: {' '.join(str(error).split())}") from None
    lines: dict[Path, int] = {}
    return Document({} if root is None else _build(root, (), lines, name), lines)


def _build(node: yaml.Node, path: Path, lines: dict[Path, int], name: str = "") -> Any:
    line = node.start_mark.line + 1
    if len(path) > _DEEPEST:  # an alias of itself has no end
        raise YamlProblem(line, f"{'.'.join(path[:3])}...: nested too deeply")
    lines.setdefault(path, line)
    if isinstance(node, yaml.MappingNode):
        return _build_mapping(node, path, lines)
    if isinstance(node, yaml.SequenceNode):
        return [_build(item, (*path, str(i)), lines) for i, item in enumerate(node.value)]
    return _scalar(node, ".".join(path) or name, line)


def _build_mapping(node: yaml.MappingNode, path: Path, lines: dict[Path, int]) -> dict[str, Any]:
    mapping: dict[str, Any] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            raise YamlProblem(line, "a key must be a plain word")
        key = str(key_node.value)
        here = (*path, key)
        if key in mapping:
            raise YamlProblem(
                line,
                f"{'.'.join(here)}: duplicate key, first given on line {lines[here]}; keep one",
            )
        lines[here] = line
        mapping[key] = _build(value_node, here, lines)
    return mapping


def _scalar(node: yaml.Node, name: str, line: int) -> Any:
    if isinstance(node, yaml.ScalarNode) and node.style is None:  # plain, not quoted
        surprise = _surprise(str(node.value), node.tag)
        if surprise:
            raise YamlProblem(line, f"{name}: '{node.value}' {surprise}")
    try:
        return yaml.SafeLoader("").construct_object(node, deep=True)
    except (yaml.YAMLError, ValueError) as error:
        raise YamlProblem(line, f"{name}: {' '.join(str(error).split())}") from None


def _surprise(text: str, tag: str) -> str | None:
    """What YAML 1.1 takes a plain scalar for that people do not, and what to write instead."""
    if text.lower() in _WORDS:
        meant = _WORDS[text.lower()]
        return f"is {meant} in YAML; write {meant}, or quote it where a text is meant"
    if tag.endswith(":str") and _BARE_EXPONENT.fullmatch(text):
        return f"is a text in YAML, not a number; write {_dotted(text)}"
    if tag.endswith((":int", ":float")) and _SEXAGESIMAL.fullmatch(text):
        return "counts in sixties in YAML; write a plain number"
    if tag.endswith(":int") and _OCTAL.fullmatch(text):
        return "is octal in YAML; leave out the leading zero"
    return None


def _dotted(text: str) -> str:
    """The exponent form that YAML 1.1 does read as a number: a dot and a signed exponent."""
    mantissa, _, exponent = text.lower().partition("e")
    mantissa = mantissa if "." in mantissa else mantissa + ".0"
    return f"{mantissa}e{exponent if exponent[0] in '+-' else '+' + exponent}"
