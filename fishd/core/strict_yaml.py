"""YAML as people mean it: values with the line they stand on, and no silent surprises.

PyYAML follows YAML 1.1, in which `on` is true, `1e2` is a text, `1:30` is ninety and the second of
two equal keys wins. Each of these is refused here, with the line and what to write instead.
"""

import re
from typing import Any, NamedTuple

import yaml

from fishd.files import SETTINGS

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
_LONGEST = SETTINGS
"""Longest text [characters]."""
_MOST = 2000
"""Values and keys in one document; an alias counts as all that it stands for."""
_LONGEST_NUMBER = 100
_OCTAL = re.compile(r"[-+]?0[0-7_]+")


def parse(text: str, name: str = "the document") -> Document:
    """Parse `text`; raises `YamlProblem`. A lone value is called `name` in complaints."""
    if len(text) > _LONGEST:
        raise YamlProblem(1, f"longer than {_LONGEST // 2**10} kB")
    try:
        root = _Loader(text).get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise YamlProblem(line, f"not valid YAML: {error.problem}") from None
    except yaml.YAMLError as error:
        raise YamlProblem(1, f"not valid YAML: {' '.join(str(error).split())}") from None
    builder = _Builder(name)
    return Document({} if root is None else builder.build(root, ()), builder.lines)


class _Loader(yaml.SafeLoader):
    """Gives up as soon as a text is larger or deeper than any document of people is."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._count = self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """As the loader does, which calls this for each node in the text."""
        self._count += 1
        self._depth += 1
        line = int(self.line) + 1
        if self._depth > _DEEPEST + 1:
            raise YamlProblem(line, "nested too deeply")
        _check_count(self._count, line)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


class _Builder:
    """Makes plain values of the nodes of a document."""

    def __init__(self, name: str) -> None:
        self.lines: dict[Path, int] = {}
        self._name = name
        self._count = 0
        self._constructor = yaml.constructor.SafeConstructor()

    def build(self, node: yaml.Node, path: Path) -> Any:
        """The value of a node, which is found under these keys."""
        line = node.start_mark.line + 1
        self._count += 1
        _check_count(self._count, line)
        if len(path) > _DEEPEST:  # an alias of itself has no end
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
            here = (*path, key)
            if key in mapping:
                raise YamlProblem(
                    line,
                    f"{'.'.join(here)}: duplicate key, first given on line {self.lines[here]}; "
                    "keep one",
                )
            self.lines[here] = line
            mapping[key] = self.build(value_node, here)
        return mapping

    def _scalar(self, node: yaml.ScalarNode, name: str, line: int) -> Any:
        length = len(node.value)
        if length > _LONGEST_NUMBER and node.tag.endswith((":int", ":float")):
            raise YamlProblem(line, f"{name}: a number of {length} letters")
        if length <= _LONGEST_NUMBER and node.style is None:  # plain, not quoted
            surprise = _surprise(str(node.value), node.tag)
            if surprise:
                raise YamlProblem(line, f"{name}: '{node.value}' {surprise}")
        try:
            return self._constructor.construct_object(node, deep=True)
        except (yaml.YAMLError, ValueError) as error:
            raise YamlProblem(line, f"{name}: {' '.join(str(error).split())}") from None


def _check_count(count: int, line: int) -> None:
    if count > _MOST:
        raise YamlProblem(
            line,
            f"more than {_MOST} values and keys, each alias counted as all that it stands for",
        )


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
