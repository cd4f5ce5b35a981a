"""Builds the Debian package of fishd: `python tools/deb [--machine arm64] [--python 3.13]`."""

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # tools/

from deb.package import main  # noqa: E402

main()
