"""Parts of the documentation for tests: prose, blocks, code, tables."""

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
"""Fenced block: its kind, and its content."""
_SPAN = re.compile(r"`([^`\n]+)`")


def text_of(document: Path) -> str:
    return document.read_text(encoding="utf-8")


def prose_of(document: Path) -> str:
    return FENCE.sub("", text_of(document))


def code_of(document: Path) -> Iterator[str]:
    """Return each line of a fenced block, with continued ones joined, and each code span."""
    for _, block in FENCE.findall(text_of(document)):
        yield from block.replace("\\\n", " ").splitlines()
    yield from _SPAN.findall(prose_of(document))


def first_cells(document: Path, heading: str) -> list[str]:
    """Return the code in the first column of the tables between a heading and the next one."""
    section = re.split(rf"^#+ {re.escape(heading)}$", text_of(document), flags=re.MULTILINE)[1]
    section = re.split(r"^#", section, flags=re.MULTILINE)[0]
    return re.findall(r"^\| `([^`]+)`", section, re.MULTILINE)
