"""Texts in pictures."""

from pathlib import Path
from xml.etree import ElementTree


def letters_of(picture: Path) -> str:
    """Return the text of an SVG picture whose text is stored as text, without spaces."""
    return "".join("".join(ElementTree.parse(picture).getroot().itertext()).split())
