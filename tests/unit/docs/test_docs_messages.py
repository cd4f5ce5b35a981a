"""Messages in the documentation, word by word, against the sources; and every reason."""

import ast
import errno
import os
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache

import pytest
from rigs.documents import FENCE, ROOT, text_of

from fishd.control.faults import FAULTS


def sources() -> Iterator[str]:
    for path in sorted((ROOT / "fishd").rglob("*.py")):
        yield path.read_text(encoding="utf-8")


def test_every_fault_that_fishd_latches_is_in_the_table_and_no_other() -> None:
    code = re.compile(r"(?:\bfail\(|_fail\(|\.check\(|ControllerFault\()\s*\"([a-z-]+)\"")
    assert {fault for text in sources() for fault in code.findall(text)} == FAULTS.keys()


def test_troubleshooting_has_a_section_for_each_fault_and_no_other() -> None:
    document = text_of(ROOT / "docs" / "how-to" / "troubleshooting.md")
    section = document.split("## By reason")[1].split("\n## ")[0]
    assert set(re.findall(r"^### (\S+)$", section, re.MULTILINE)) == FAULTS.keys()


Template = tuple[str, ...]
"""A message of the sources: its literal parts, with a gap for a value between each two."""
MIN_LETTERS = 7
"""Smallest number of letters in the literal parts of a message."""


def template_of(node: ast.expr) -> Template | None:
    """Return the template of a string expression, or None for any other expression."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return tuple(re.split(r"\{\w+\}|%[sdg]", node.value))
    if isinstance(node, ast.JoinedStr):
        parts = [""]
        for value in node.values:
            if isinstance(value, ast.Constant):
                parts[-1] += str(value.value)
            else:
                parts.append("")
        return tuple(parts)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = template_of(node.left), template_of(node.right)
        if left is None and right is None:
            return None
        left, right = left or ("", ""), right or ("", "")
        return (*left[:-1], left[-1] + right[0], *right[1:])
    return None


@cache
def templates() -> tuple[Template, ...]:
    """Return every message of the sources, without docstrings, and those of Linux."""
    literals: set[Template] = {(os.strerror(number),) for number in errno.errorcode}
    for source in sources():
        nodes = list(ast.walk(ast.parse(source)))
        docs = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        for node in nodes:
            if isinstance(node, ast.expr) and id(node) not in docs and (t := template_of(node)):
                literals.add(t)
    return tuple(t for t in literals if len(re.findall(r"[a-zA-Z]", "".join(t))) >= MIN_LETTERS)


def quoted_messages() -> list[str]:
    """Return the messages in troubleshooting.md: tables of messages and lines, text blocks."""
    document = text_of(ROOT / "docs" / "how-to" / "troubleshooting.md")
    blocks = [block for kind, block in FENCE.findall(document) if kind == "text"]
    table = re.compile(r"^\| (?:message|line) \|.*\n\|[-|]+\n((?:\|.*\n)+)", re.MULTILINE)
    tables = table.findall(document)
    rows = "".join(tables)
    return "".join(blocks).splitlines() + re.findall(r"^\| `([^`]+)`", rows, re.MULTILINE)


@cache
def templates_by_ends() -> defaultdict[tuple[str, str], list[tuple[str, Template]]]:
    """Return longest parts and templates by first and last two letters, "" where a gap may be."""
    by_ends = defaultdict(list)
    for template in templates():
        first, last = template[0][:2], template[-1][-2:]
        ends = first if len(first) == 2 else "", last if len(last) == 2 else ""
        by_ends[ends].append((max(template, key=len), template))
    return by_ends


UNITS = "µs|ms|s|N|V|rad|Hz|mN rms|mN"
VALUE = re.compile(
    rf"(?:…|[^ ]*[/…:@][^ ]*|'[^']*'|load \d|[+-]?\d[^ ]*(?: (?:{UNITS}))?|[\w.\[\]-]+)"
)
"""Pattern of the text in a gap: a number, a name, a path, a quoted text, or `…`."""
JOINED = re.compile(r"(?:, | and | or | to )")


@cache
def is_value(text: str) -> bool:
    """Return whether a text is one value, a list of values, or another message."""
    if not text or VALUE.fullmatch(text) or (text[0] == "(" and text[-1] == ")"):
        return True
    parts = JOINED.split(text)
    if len(parts) > 1 and all(part and is_value(part) for part in parts):
        return True
    return is_message(text)


@cache
def is_message(text: str) -> bool:
    """Return whether a text is a string of the sources, with values in its gaps."""
    if len(re.findall(r"[a-zA-Z]", text)) < MIN_LETTERS:
        return False
    candidates = templates_by_ends()[text[:2], ""] + templates_by_ends()["", text[-2:]]
    candidates += templates_by_ends()[text[:2], text[-2:]] + templates_by_ends()["", ""]
    near = (template for longest, template in candidates if longest in text)
    if any(fits(template, text) for template in near if could_fit(template, text)):
        return True
    head, colon, tail = text.partition(": ")
    if colon and is_value(head) and is_message(tail):
        return True
    path, _, tail = text.partition(" ")
    if path.startswith("/") and is_message(tail):
        return True
    places = [match.start() for match in re.finditer("; ", text)]
    return any(is_hint(text[place:]) and is_message(text[:place]) for place in places)


@cache
def hints() -> tuple[Template, ...]:
    return tuple(template for template in templates() if template[0].startswith("; "))


def is_hint(text: str) -> bool:
    """Return whether a text may follow a message, such as `; reconnecting`."""
    return any(fits(template, text) for template in hints())


def could_fit(template: Template, text: str) -> bool:
    """Return False, quickly, for most templates that do not fit, or where most would be values."""
    return (
        text.startswith(template[0])
        and text.endswith(template[-1])
        and all(part in text for part in template)
        and (max(map(len, template)) > 12 or 4 * sum(map(len, template)) >= len(text))
    )


def fits(template: Template, text: str) -> bool:
    """Return whether a text is this template, with a value or nothing in each gap."""
    first, *rest = template
    if not text.startswith(first):
        return False
    left = text[len(first) :]
    if not rest:
        return not left
    if not all(part in left for part in rest):
        return False
    return any(
        left.startswith(rest[0], gap) and is_value(left[:gap]) and fits(tuple(rest), left[gap:])
        for gap in range(len(left) + 1)
    )


def test_every_message_that_is_quoted_is_one_that_fishd_prints() -> None:
    assert [line for line in quoted_messages() if not is_message(line)] == []


NEGATIONS = (
    ("cannot", "can"), ("has not", "has"), ("does not", "does"), ("is not", "is"), ("no ", "a "),
    (" is ", " is not "), (" are ", " are not "), (" must ", " must not "), ("more ", "less "),
    ("at most", "at least"), (" may not ", " may "), (" beyond ", " within "),
)  # fmt: skip


def falsify(line: str) -> Iterator[str]:
    """Yield a line with one word dropped that is not a value, or with its meaning negated."""
    for word in re.finditer(r"(?<!\S)[a-zA-Z]{2,}(?!\S) ", line):
        yield line[: word.start()] + line[word.end() :]
    for said, contrary in NEGATIONS:
        if said in line:
            yield line.replace(said, contrary, 1)


@pytest.mark.slow
def test_a_dropped_word_or_a_negation_is_noticed() -> None:
    falsified = [wrong for line in quoted_messages() for wrong in falsify(line)]
    assert [wrong for wrong in falsified if is_message(wrong)] == []
