"""Benchmarks: `python tools/bench NAME [OPTIONS]`, or `python -m bench NAME` in tools/."""

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # tools/

from common.report import run  # noqa: E402

NAMES = ("tick", "accuracy", "camera", "fin_angle", "swimmer", "window")

if __name__ == "__main__":
    sys.exit(run("bench", NAMES))
