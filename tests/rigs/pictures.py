"""Texts in pictures, and the settings of a simulated camera."""

from contextlib import AbstractContextManager
from pathlib import Path
from unittest.mock import patch
from xml.etree import ElementTree

from fishd.camera.settings import load_simulated
from fishd.core.files import shipped_folder
from fishd.lab import drawing

WEB = load_simulated(shipped_folder("config") / "camera-web.yaml")
"""Settings of a cheap USB camera on a stand."""


def texts_in_pictures() -> AbstractContextManager[object]:
    """Store the text of SVG pictures as text, not as curves."""
    return patch.dict(drawing._STYLE, {"svg.fonttype": "none"})


def letters_of(picture: Path) -> str:
    """Return the text of an SVG picture whose text is stored as text, without spaces."""
    return "".join("".join(ElementTree.parse(picture).getroot().itertext()).split())
