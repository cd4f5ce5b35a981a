"""Reproduction of the paper's figures and numbers: `make figures`, or `python tools/paper`."""

import argparse
import os
import sys
import time
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # tools/

from common.report import DOCS, progress, put  # noqa: E402
from paper import claims, figure_2b, figure_3, figure_4, figure_5, figure_6, swing_map  # noqa: E402
from paper.runs import FOLDER  # noqa: E402

PARTS = (swing_map, figure_2b, figure_3, figure_4, figure_5, figure_6)
"""Modules with `compute(jobs)`, which writes tables, and `draw()`, which reads them."""


def main() -> None:
    """Write docs/figures/ and the parts of docs/explanation/ with their numbers."""
    parser = argparse.ArgumentParser(prog="tools/paper", description=__doc__)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    jobs = parser.parse_args().jobs
    FOLDER.mkdir(exist_ok=True)
    for part in PARTS:
        begun = time.monotonic()
        part.compute(jobs)
        part.draw()
        progress(part.__name__, f"{time.monotonic() - begun:.0f} s")
    for document, section, text in (*claims.sections(), *swing_map.sections()):
        put(DOCS / document, section, text)


if __name__ == "__main__":
    main()
