"""What the documentation says that fishd prints: every reason, and every message word by word."""

import ast
import errno
import os
import re
from collections.abc import Iterator
from functools import cache

import pytest
from documents import FENCE, ROOT, text_of


def sources() -> Iterator[str]:
    for path in sorted((ROOT / "fishd").rglob("*.py")):
        yield path.read_text(encoding="utf-8")


def reason_codes() -> set[str]:
    """Every code that a fault or an emergency stop can have, in the loop's sources."""
    code = re.compile(r"(?:\bfail\(|_fail\(|Reason\(code=|ControllerFault\()\s*\"([a-z-]+)\"")
    return {found for text in sources() for found in code.findall(text)}


def test_troubleshooting_has_a_section_for_each_reason_and_no_other() -> None:
    document = text_of(ROOT / "docs" / "troubleshooting.md")
    section = document.split("## By reason")[1].split("\n## ")[0]
    assert set(re.findall(r"^### (\S+)$", section, re.MULTILINE)) == reason_codes()


def test_concepts_lists_each_reason() -> None:
    text = text_of(ROOT / "docs" / "concepts.md")
    assert {code for code in reason_codes() if f"`{code}`" not in text} == set()


@cache
def phrases() -> frozenset[str]:
    """What the sources print, cut at the gaps for values; and words of Linux."""
    found = {os.strerror(number) for number in errno.errorcode}
    for source in sources():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.update(re.split(r"\{\w+\}|%[sdg]", node.value))
    return frozenset(phrase for phrase in found if len(phrase) >= 8 and "\n" not in phrase)


def quoted_messages() -> list[str]:
    """What troubleshooting.md says that fishd prints: tables of messages and lines, text blocks."""
    document = text_of(ROOT / "docs" / "troubleshooting.md")
    blocks = [block for kind, block in FENCE.findall(document) if kind == "text"]
    table = re.compile(r"^\| (?:message|line) \|.*\n\|[-|]+\n((?:\|.*\n)+)", re.MULTILINE)
    tables = table.findall(document)
    rows = "".join(tables)
    return "".join(blocks).splitlines() + re.findall(r"^\| `([^`]+)`", rows, re.MULTILINE)


VALUES = re.compile(
    r"…|/\S+|0x\d+|127\.0\.0\.1:\d+|A\d-A\d|[+-]?\d+(\.\d+)?|\bF?_?[xy]\b|-[xy]\b"
    r"|\w+\.\w+(?=: unknown key)|'\w+'"
)
"""What differs from run to run."""


@pytest.mark.parametrize("line", quoted_messages())
def test_every_message_that_is_quoted_is_one_that_fishd_prints(line: str) -> None:
    covered = [False] * len(line)
    for phrase in phrases():
        for place in re.finditer(re.escape(phrase), line):
            covered[place.start() : place.end()] = [True] * len(phrase)
    for value in VALUES.finditer(line):
        covered[value.start() : value.end()] = [True] * len(value[0])
    left = "".join(" " if c else letter for letter, c in zip(line, covered, strict=True)).split()
    assert sum(map(len, left)) <= 0.15 * len(line), left
