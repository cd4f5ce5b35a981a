"""What a picture says."""

from pathlib import Path
from xml.etree import ElementTree


def letters_of(picture: Path) -> str:
    """What is written in an SVG picture whose text was kept as text, without any spaces."""
    return "".join("".join(ElementTree.parse(picture).getroot().itertext()).split())
