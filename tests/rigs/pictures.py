"""Texts in pictures."""

from contextlib import AbstractContextManager
from pathlib import Path
from unittest.mock import patch
from xml.etree import ElementTree

from fishd.lab import drawing


def texts_in_pictures() -> AbstractContextManager[object]:
    """Store the text of SVG pictures as text, not as curves."""
    return patch.dict(drawing._STYLE, {"svg.fonttype": "none"})


def letters_of(picture: Path) -> str:
    """Return the text of an SVG picture whose text is stored as text, without spaces."""
    return "".join("".join(ElementTree.parse(picture).getroot().itertext()).split())
