"""The wheel of fishd, built from the checkout."""

import contextlib
from pathlib import Path

from hatchling.build import build_wheel

from rigs.documents import ROOT


def build(folder: Path) -> Path:
    """Build the wheel into a folder; return its file."""
    with contextlib.chdir(ROOT):
        return folder / build_wheel(str(folder))
